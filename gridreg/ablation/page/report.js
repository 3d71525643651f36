"use strict";

// Tables: a click on a heading sorts by it, another one the other way round; rows without a figure stay last.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[0].cells];
  const valueOf = (row, column) => {
    const text = row.cells[column].dataset.value;
    return text === "" ? null : column === 0 ? text : Number(text);
  };
  headings.forEach((heading, column) => {
    const button = heading.querySelector("button");
    if (!button) return;
    button.addEventListener("click", () => {
      // Figures begin with the largest, names with the first.
      const first = column === 0 ? "ascending" : "descending";
      const other = column === 0 ? "descending" : "ascending";
      const order = heading.getAttribute("aria-sort") === first ? other : first;
      for (const each of headings) each.removeAttribute("aria-sort");
      heading.setAttribute("aria-sort", order);
      const sign = order === "ascending" ? 1 : -1;
      const compare = (a, b) => {
        const [x, y] = [valueOf(a, column), valueOf(b, column)];
        if (x === null || y === null) return (x === null) - (y === null);
        return sign * (typeof x === "string" ? x.localeCompare(y) : x - y);
      };
      body.append(...[...body.rows].sort(compare));
    });
  });
}

// Curves: the line under the pointer, or whose name is, stands out.
for (const part of document.querySelectorAll(".curves")) {
  const light = (name) => {
    part.classList.toggle("fade", name !== null);
    for (const each of part.querySelectorAll("[data-series]")) each.classList.toggle("lit", each.dataset.series === name);
  };
  const nameAt = (event) => event.target.closest("[data-series]")?.dataset.series ?? null;
  part.addEventListener("pointerover", (event) => light(nameAt(event)));
  part.addEventListener("pointerleave", () => light(null));
}

// The slider between two renders of one view.
const pictures = JSON.parse(document.getElementById("pictures").textContent);
for (const wipe of document.querySelectorAll(".wipe")) {
  const views = pictures[Number(wipe.dataset.section)];
  const find = (name) => wipe.querySelector(`[name=${name}]`);
  const [scene, view, left, right, at] = ["scene", "view", "left", "right", "at"].map(find);
  const stage = wipe.querySelector(".stage");
  const [under, top] = [stage.querySelector(".under"), stage.querySelector(".top")];

  const fill = (select, names, wanted) => {
    select.replaceChildren(...names.map((name) => new Option(name, name)));
    select.value = names.includes(wanted) ? wanted : names[0];
  };
  const current = () => views.find((each) => each.scene === scene.value && each.view === view.value);
  const tag = (image) => (image.psnr === null ? image.name : `${image.name}  ${image.psnr.toFixed(2)} dB`);
  const show = () => {
    const images = current().images;
    for (const [select, picture, label] of [[left, top, "left"], [right, under, "right"]]) {
      const image = images.find((each) => each.name === select.value);
      picture.src = image.src;
      picture.alt = `${scene.value}, ${view.value}: ${tag(image)}`;
      stage.querySelector(`.tag.${label}`).textContent = tag(image);
    }
    wipe.querySelector(".seed").textContent = current().seed;
  };
  const chooseView = () => {
    const names = current().images.map((image) => image.name);
    fill(left, names, left.value || wipe.dataset.left);
    fill(right, names, right.value || wipe.dataset.right);
    show();
  };
  const chooseScene = () => {
    fill(view, views.filter((each) => each.scene === scene.value).map((each) => each.view), view.value);
    chooseView();
  };
  const move = () => stage.style.setProperty("--at", `${at.value}%`);

  for (const picture of [under, top])
    picture.addEventListener("load", () => picture.classList.toggle("small", picture.naturalWidth < 200));
  scene.addEventListener("change", chooseScene);
  view.addEventListener("change", chooseView);
  left.addEventListener("change", show);
  right.addEventListener("change", show);
  at.addEventListener("input", move);
  wipe.querySelector("button").addEventListener("click", () => {
    [left.value, right.value] = [right.value, left.value];
    show();
  });
  fill(scene, [...new Set(views.map((each) => each.scene))], null);
  chooseScene();
  move();
}
