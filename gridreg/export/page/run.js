"use strict";

// The object to turn: a mesh with vertex colours, photographs as rectangles before their cameras.
const data = JSON.parse(document.getElementById("data").textContent);
const canvas = document.querySelector(".object canvas");
const gl = canvas.getContext("webgl2", { antialias: true });
const strip = [...document.querySelectorAll(".strip button")];
const shown = document.getElementById("cameras");

const add = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((v) => v / (Math.hypot(...a) || 1));
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

const middle = data.low.map((v, i) => (v + data.high[i]) / 2);
const radius = Math.hypot(...add(data.high, data.low, -1)) / 2;
// From a camera to its photograph.
const DEPTH = 0.22 * radius;
const TANGENT = Math.tan(Math.PI / 9);

// Right, up and back of the view, the point it turns around, the distance to it, and the tangents of half of its
// field of view, of which the whole is seen.
const first = () => {
  const back = unit(data.front), right = unit(cross(data.up, back));
  return { axes: [right, cross(back, right), back], target: middle, distance: 1.15 * radius / Math.sin(Math.atan(TANGENT)), field: [TANGENT, TANGENT] };
};
const ofCamera = ({ pose, edges }) => {
  const axes = [0, 1, 2].map((i) => [pose[i], pose[i + 4], pose[i + 8]]), place = [pose[3], pose[7], pose[11]];
  const distance = Math.max(dot(add(place, middle, -1), axes[2]), 0.1 * radius);
  return { axes, target: add(place, axes[2], -distance), distance, field: [(edges[1] - edges[0]) / 2, (edges[3] - edges[2]) / 2] };
};
let view = first(), moving = 0;
const eye = () => add(view.target, view.axes[2], view.distance);

const turnAbout = (axis, angle) => {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  view.axes = view.axes.map((v) => add(add(v.map((x) => c * x), cross(axis, v), s), axis, (1 - c) * dot(axis, v)));
};
const turn = (x, y) => {
  turnAbout(data.up, -x);
  // Not over the poles.
  const tilt = Math.asin(Math.max(-1, Math.min(1, dot(view.axes[2], data.up))));
  turnAbout(view.axes[0], tilt - Math.max(-1.55, Math.min(1.55, tilt + y)));
  draw();
};
const nearer = (factor) => {
  view.distance = Math.max(0.05 * radius, Math.min(40 * radius, view.distance * factor));
  draw();
};
const slide = (x, y) => {
  const scale = 2 * view.distance * Math.max(...view.field) / Math.min(canvas.clientWidth, canvas.clientHeight);
  view.target = add(add(view.target, view.axes[0], -x * scale), view.axes[1], y * scale);
  draw();
};
const goTo = (goal, number) => {
  strip.forEach((button, i) => button.setAttribute("aria-pressed", i === number));
  const start = view, began = performance.now(), turnNumber = ++moving;
  const length = matchMedia("(prefers-reduced-motion: reduce)").matches ? 0 : 500;
  const mix = (a, b, t) => (Array.isArray(a) ? a.map((v, i) => mix(v, b[i], t)) : a + t * (b - a));
  const step = () => {
    if (turnNumber !== moving) return;
    const part = length ? Math.min(1, (performance.now() - began) / length) : 1;
    const t = part * part * (3 - 2 * part);
    const back = unit(mix(start.axes[2], goal.axes[2], t)), right = unit(cross(mix(start.axes[1], goal.axes[1], t), back));
    const between = (key) => mix(start[key], goal[key], t);
    view = { axes: [right, cross(back, right), back], target: between("target"), distance: between("distance"), field: between("field") };
    if (part === 1) view = { ...goal };
    draw();
    if (part < 1) requestAnimationFrame(step);
  };
  step();
};

let draw = () => {};
let matrix = null;

if (gl) {
  const program = (vertex, fragment) => {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, `#version 300 es\nprecision highp float;\n${text}`);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    ["place", "extra"].forEach((name, i) => gl.bindAttribLocation(made, i, name));
    gl.linkProgram(made);
    return (name) => (name === undefined ? made : gl.getUniformLocation(made, name));
  };
  const VERTEX = `in vec3 place; in vec3 extra; out vec3 carried; uniform mat4 matrix; uniform vec3 low, size;
    void main() { carried = extra; gl_Position = matrix * vec4(low + size * place, 1.0); }`;
  const solid = program(VERTEX, "in vec3 carried; out vec4 colour; void main() { colour = vec4(carried, 1.0); }");
  const photo = program(VERTEX, "in vec3 carried; out vec4 colour; uniform sampler2D atlas; void main() { colour = texture(atlas, carried.xy); }");
  const array = (content, kind, normalized) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, content, gl.STATIC_DRAW);
    return (index) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(index);
      gl.vertexAttribPointer(index, 3, kind, normalized, 0, 0);
    };
  };
  const places = array(bytes(data.places), gl.UNSIGNED_SHORT, true), colours = array(bytes(data.colours), gl.UNSIGNED_BYTE, true);
  const faces = gl.createBuffer();
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, faces);
  const corners = bytes(data.faces), wide = data.wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);

  // Frustums: lines from each camera to the corners of its image, which is a textured rectangle.
  const lines = [], squares = [], textures = [], shades = [];
  const columns = Math.ceil(Math.sqrt(data.cameras.length)) || 1;
  const accent = getComputedStyle(document.documentElement).getPropertyValue("--up").trim();
  const shade = [1, 3, 5].map((i) => parseInt(accent.slice(i, i + 2), 16) / 255);
  [...data.cameras, ...(data.next ? [data.next] : [])].forEach(({ pose, edges: [l, r, b, t] }, i) => {
    const place = [pose[3], pose[7], pose[11]];
    const at = (x, y) => [0, 1, 2].map((k) => place[k] + DEPTH * (pose[4 * k] * x + pose[4 * k + 1] * y - pose[4 * k + 2]));
    const ring = [at(l, t), at(r, t), at(r, b), at(l, b)];
    ring.forEach((corner, k) => lines.push(...place, ...corner, ...corner, ...ring[(k + 1) % 4]));
    for (let k = 0; k < 16; k++) shades.push(...(i < data.cameras.length ? shade : [0.85, 0.2, 0.55]));
    const [u, v] = [i % columns, Math.floor(i / columns)].map((x) => x / columns), s = 1 / columns;
    const uv = [[u, v], [u + s, v], [u + s, v + s], [u, v + s]];
    for (const k of [0, 1, 2, 0, 2, 3]) { squares.push(...ring[k]); textures.push(...uv[k], 0); }
  });
  const [linePlaces, lineShades, squarePlaces, squareTextures] = [lines, shades, squares, textures].map((x) => array(new Float32Array(x), gl.FLOAT, false));
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([128, 128, 128, 255]));
  Promise.all(strip.map((button) => button.firstElementChild.decode().catch(() => null))).then(() => {
    const cell = Math.min(160, Math.floor(2048 / columns)), sheet = document.createElement("canvas");
    sheet.width = sheet.height = cell * columns;
    const pen = sheet.getContext("2d");
    strip.forEach((button, i) => pen.drawImage(button.firstElementChild, cell * (i % columns), cell * Math.floor(i / columns), cell, cell));
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, sheet);
    draw();
  });

  const use = (which, low, size) => {
    gl.useProgram(which());
    gl.uniformMatrix4fv(which("matrix"), false, matrix);
    gl.uniform3fv(which("low"), low);
    gl.uniform3fv(which("size"), size);
  };
  let waiting = false;
  const paint = () => {
    waiting = false;
    const ratio = Math.min(2, devicePixelRatio || 1);
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((x) => Math.max(1, Math.round(x * ratio)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    const [r, g, b] = getComputedStyle(canvas).backgroundColor.match(/[\d.]+/g).map((x) => x / 255);
    gl.clearColor(r, g, b, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    // The whole field of view is seen, however wide the canvas is.
    const scale = Math.max(view.field[0] / width, view.field[1] / height), [tx, ty] = [scale * width, scale * height];
    const from = eye(), near = 0.02 * view.distance, far = view.distance + 20 * radius + near;
    const [x, y, z] = view.axes, d = [-dot(x, from), -dot(y, from), -dot(z, from)], k = (far + near) / (near - far), m = 2 * far * near / (near - far);
    matrix = new Float32Array([0, 1, 2].flatMap((i) => [x[i] / tx, y[i] / ty, k * z[i], -z[i]]).concat([d[0] / tx, d[1] / ty, k * d[2] + m, -d[2]]));
    use(solid, data.low, add(data.high, data.low, -1));
    places(0); colours(1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, faces);
    gl.drawElements(gl.TRIANGLES, corners.byteLength / (data.wide ? 4 : 2), wide, 0);
    if (!data.cameras.length || !shown.checked) return;
    if (data.next) {
      use(solid, [0, 0, 0], [1, 1, 1]);
      linePlaces(0); lineShades(1);
      gl.drawArrays(gl.LINES, 16 * data.cameras.length, 16);
    }
    // The photograph of a camera that one looks out of, or that is close by, would hide all.
    data.cameras.forEach(({ pose }, i) => {
      if (Math.hypot(from[0] - pose[3], from[1] - pose[7], from[2] - pose[11]) < Math.max(DEPTH, 0.4 * view.distance)) return;
      use(solid, [0, 0, 0], [1, 1, 1]);
      linePlaces(0); lineShades(1);
      gl.drawArrays(gl.LINES, 16 * i, 16);
      use(photo, [0, 0, 0], [1, 1, 1]);
      squarePlaces(0); squareTextures(1);
      gl.drawArrays(gl.TRIANGLES, 6 * i, 6);
    });
  };
  draw = () => {
    if (!waiting) requestAnimationFrame(paint);
    waiting = true;
  };
  new ResizeObserver(() => draw()).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw());
} else {
  document.getElementById("help").textContent = "This browser has no WebGL 2, which turning the object needs.";
}

// Fingers and mouse: one turns, two come nearer and move; a tap on a photograph goes to its camera.
const fingers = new Map();
let tapped = null;
const spread = () => {
  const [a, b] = [...fingers.values()];
  return b ? { length: Math.hypot(a.x - b.x, a.y - b.y), x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 } : null;
};
canvas.addEventListener("pointerdown", (event) => {
  moving++;
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  tapped = fingers.size === 1 ? { x: event.clientX, y: event.clientY } : null;
});
canvas.addEventListener("pointermove", (event) => {
  const finger = fingers.get(event.pointerId);
  if (!finger) return;
  const [x, y] = [event.clientX - finger.x, event.clientY - finger.y], before = spread();
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  if (tapped && Math.hypot(event.clientX - tapped.x, event.clientY - tapped.y) > 6) tapped = null;
  const after = spread();
  if (after) {
    if (after.length > 0) nearer(before.length / after.length);
    slide(after.x - before.x, after.y - before.y);
  } else if (event.shiftKey || event.buttons & 6) slide(x, y);
  else turn(x / 130, y / 130);
});
for (const kind of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(kind, (event) => {
    fingers.delete(event.pointerId);
    if (kind === "pointerup" && tapped) tap(event);
    tapped = null;
  });
}
// The pixel of the window where a camera's photograph is, and how far away; null behind the view.
const pixelOf = ({ pose }) => {
  const p = [0, 1, 2].map((k) => pose[4 * k + 3] - DEPTH * pose[4 * k + 2]), box = canvas.getBoundingClientRect();
  const [x, y, w] = [0, 1, 3].map((row) => matrix[row] * p[0] + matrix[4 + row] * p[1] + matrix[8 + row] * p[2] + matrix[12 + row]);
  return w > 0 ? [box.left + box.width * (1 + x / w) / 2, box.top + box.height * (1 - y / w) / 2, w] : null;
};
const tap = (event) => {
  if (!matrix || !shown?.checked) return;
  let best = null;
  data.cameras.forEach((camera, i) => {
    const pixel = pixelOf(camera), away = pixel ? Math.hypot(pixel[0] - event.clientX, pixel[1] - event.clientY) : Infinity;
    if (away < 36 && (!best || away < best.away)) best = { away, i };
  });
  if (best) goTo(ofCamera(data.cameras[best.i]), best.i);
};
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  nearer(Math.exp(event.deltaY * (event.deltaMode ? 0.03 : 0.0012)));
}, { passive: false });
canvas.addEventListener("keydown", (event) => {
  const act = { ArrowLeft: () => turn(-0.1, 0), ArrowRight: () => turn(0.1, 0), ArrowUp: () => turn(0, -0.1), ArrowDown: () => turn(0, 0.1), "+": () => nearer(0.9), "-": () => nearer(1.1) }[event.key];
  if (!act) return;
  event.preventDefault();
  moving++;
  act();
});
document.getElementById("reset").addEventListener("click", () => goTo(first()));
shown?.addEventListener("change", () => draw());
strip.forEach((button, i) => button.addEventListener("click", () => goTo(ofCamera(data.cameras[i]), i)));
draw();
