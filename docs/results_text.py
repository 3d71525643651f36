"""What docs/results.md says besides figures: its rows and studies, and what was seen in the pictures."""

from __future__ import annotations

from dataclasses import dataclass

HEAD = """# Results

Every figure on this page is computed from files in `benchmarks/results/`, one for each run: `quality/` is written by
`benchmarks/quality.py`, `ensembles/` by `benchmarks/ensembles.py`, a study's by `benchmarks/collect.py`.
`python docs/make_results.py` writes the page from them. Ours are means over the test
views of the protocol and, where there are several, over seeds; ± and [ ] are 95 % intervals (Student's t) over seeds,
or over pairs of the same scene and seed. "α" marks rows that use the pictures' alpha to carve the box. A dash is a run
that has not been made. Times are medians over seeds, on two kinds of processor (an AMD EPYC and an Intel Xeon, the
slower one) that others used as well. Runs with one thread ran beside another one on the same two cores; some seeds of
`tensorf`, `few_tensorf` and `few_tensorf_10k` ran beside a third program or were halted now and then, the clock running
on, so the times of these rows say no more than how long it takes at most.

Published figures are those of the Few TensoRF paper, whose rows for TensoRF and FreeNeRF are its own reproductions. Its
text does not say which eight views it used; its released configuration has those of `fewtensorf8`. Published baselines
scatter by 1 to 2 dB between papers, so only rows of one program under one protocol compare. The occlusion loss of the
fine-tuned row has FreeNeRF's range from the near plane, that of the raw one counts samples from the box.
`few_tensorf_finetuned` is the fine-tuned row with what helped it on validation views; it is no part of the paper.

All runs but those of `best`, `best-long` and `quick` draw pixels with replacement, where TensoRF's own program draws
each once before any again (`train.reshuffle`); what that is worth to `best`, which sees every pixel a few times, two of
its studies say. The published schedules draw longer, which leaves less to chance, but what it would be worth to them
was not measured; it is the same for all of them. `best` had 3,000 iterations of 1,024 rays and drew with replacement
when most of its studies were made, which set that; those of its draws, its length and its pieces at full length are of
`best` as it is.

"""


@dataclass(frozen=True)
class Method:
    """A row: how it is called, the run of `benchmarks/quality.py`, and what was published for it by scene."""

    name: str
    run: str
    published: dict[str, float]


SCENES = ("lego", "chair")
METHODS = (
    Method("TensoRF", "tensorf", {"lego": 23.83, "chair": 23.45}),
    Method("Few TensoRF, raw", "few_tensorf", {"lego": 25.68, "chair": 27.70}),
    Method("Few TensoRF, fine-tuned", "few_tensorf_10k", {"lego": 25.73, "chair": 27.71}),
    Method("`few_tensorf_finetuned`", "few_tensorf_finetuned", {}),
    Method("Few TensoRF, masks as printed", "few_tensorf:few_tensorf_printed", {}),
    Method("FreeNeRF", "freenerf", {"lego": 24.81, "chair": 27.01}),
    Method("in the style of FourieRF", "fourierf", {}),
    Method("in the style of SANeRF, 2,500 iterations as in its program", "sanerf --steps 2500", {}),
    Method("`quick`", "quick", {}),
    Method("`best`", "best", {}),
    Method("`best-long`", "best-long", {}),
)
BODIES = ("subject_a", "subject_b")
BODY_METHODS = (
    ("TensoRF, 50 views", "human50", "tensorf"),
    ("TensoRF, 8 views", "human8", "tensorf"),
    ("Few TensoRF, fine-tuned, 8 views", "human8", "few_tensorf_10k"),
    ("Few TensoRF, fine-tuned, 8 views, fixed ratio 0.8", "human8", "few_tensorf_10k:few_tensorf_fixed"),
    ("`few_tensorf_finetuned`, 8 views", "human8", "few_tensorf_finetuned"),
    ("`human`, 8 views", "human8", "human"),
)

FRONT = (
    ("best", ", 1,600 iterations of 1,536 rays"),
    ("best-long", ", 6,400 iterations of 1,536 rays"),
    ("quick", ", 1,200 iterations, 200^3"),
    ("tensorf", ", 15,000 iterations"),
    ("few_tensorf_finetuned", ", 10,000 iterations"),
    ("few_tensorf_10k", ", its fine-tuned row as published"),
    ("few_tensorf", ", 15,000 iterations"),
)
"""Runs that README.md shows, and what it says of each."""

GAINS = (
    "best",
    "human",
    "few_tensorf_finetuned",
    "few_tensorf_10k",
    "few_tensorf",
    "few_tensorf_10k:few_tensorf_fixed",
)
"""Runs whose gains over TensoRF README.md shows."""

ENSEMBLES = """The mean of the fields of several seeds (`gridreg ensemble`), scored on the same test views by
`benchmarks/ensembles.py`. Training takes as long as that of its members. In films of lego from 5 degrees above the
ground and of chair (`quick`), specks beside thin parts and the grain of the cloth are fainter than in one seed; what no
picture shows, such as the space under lego's body, is as hazy.

"""

STUDIES = (
    (
        "occlusion_near",
        "Where the occlusion loss of Few TensoRF begins",
        "Twenty samples from the ray's entry into the box, which shrinks to the object, or FreeNeRF's range from the "
        "near plane.",
    ),
    (
        "finetuned_search",
        "Changes to Few TensoRF, fine-tuned",
        "One change at a time. Without masks, or with masks that open soon, copies of the chair hang before the "
        "cameras, and it can be seen through itself (validation views r_14 and r_63); lego is blurred all over.",
    ),
    (
        "finetuned_full",
        "Changes to Few TensoRF, fine-tuned, at its full length",
        "The row of all three without orthogonality of lines is the preset `few_tensorf_finetuned`. That penalty costs "
        "most, in the published row as well, likely because Adam gives it its full step while colours have no gradient "
        "yet, which draws the lines to zero. With random backgrounds and a hull to begin from, stronger total "
        "variation and faster learning cost as well, and masks may open early or late.",
    ),
    (
        "best_draws",
        "Which pixels `best` draws",
        "Any at any time, as it was, or every one once before any comes again, as TensoRF's program does, and `best` "
        "now: chance leaves many pixels of eight small pictures out for long.",
    ),
    (
        "best_shorter",
        "`best` in fewer iterations, with more rays in each",
        "Every pixel drawn once before any comes again. A good part of an iteration does not depend on its rays (Adam "
        "on the grids, small operations), so fewer iterations of more rays are faster: 1,800 of 1,536 rays took less "
        "time than 2,300 of 1,024 here, and are ahead on both scenes. More rays still gain nothing. `best` takes 1,600 "
        "of 1,536, which leaves three minutes some room on the slower processor.",
    ),
    (
        "best_each",
        "Pieces of `best` at its full length",
        "One piece left out at a time; what a negative figure says is lost without it. Every piece gains on both "
        "scenes. The run with all of them is likely a lucky one: pools and faint gradients only approximate, to save "
        "time, and yet seem to gain. So rows within 0.2 dB of it are not told from chance, one by one; together the "
        "four small pieces are. What pools and faint gradients save is in the stored times.",
    ),
    (
        "best_unseen",
        "Unseen views and the space before the cameras, with `best`",
        "Penalties on patches from cameras between the training ones, rays sampled around their middle first, and "
        "gradients scaled by distance.",
    ),
    (
        "best_leave_one_out",
        "Pieces of `best` as it was, after a third of its iterations",
        "As above, with three seeds. Occlusion loss, L1 and "
        "distortion give about a tenth of a decibel each, lego more than chair, and seeds differ by more than that; "
        "the mean of the last fifth gives little, in every pair, and costs nothing. Measured when backgrounds were "
        'drawn; "no random background" is a white one.',
    ),
    (
        "best_background",
        "What stands behind the pictures while `best` trains",
        "Random colours that are drawn, or what these cost on average without their noise (`ExpectedBackground`), "
        "which `best` has had since. At full length they are alike. After 1,000 iterations, where noise counts for "
        "more, the first row of `best_others` is ahead of that of `best_lean`, which draws. (This page once compared "
        "runs of two processors here, and called the difference a gain.)",
    ),
    (
        "best_views",
        "Directions and small pieces of `best`",
        "What it has from the direction, and from L1, occlusion loss, distortion and the mean of the last fifth "
        "together: without these it loses in each of six pairs.",
    ),
    (
        "best_opaque",
        "Pieces of `best` without alpha",
        "Opaque pictures give no hull and no random backgrounds. Occlusion loss and L1 cost there; one seed.",
    ),
    (
        "best_full",
        "Changes to `best` at its full length",
        "Distortion three times as strong helps chair and costs lego; slower learning and stronger total variation "
        "change little.",
    ),
    (
        "best_lean",
        "A leaner `best`",
        "With drawn backgrounds, as it was. Half the components of appearance, or a narrower colour network, are as "
        "good after these few iterations; both together lose on both scenes.",
    ),
    (
        "best_others",
        "Remedies that `best` does without",
        "Of others, added or changed one at a time. Weight decay changes less than seeds do. All else loses on both "
        "scenes: a blur that clears (spatial annealing) and the entropy of rays most, resampling at other times, too.",
    ),
    (
        "best_precision",
        "Precision of the colour network of `best`",
        "Products of bfloat16 are what processors with AVX-512 BF16 take by themselves. They cost nothing that seeds "
        "would not hide; here they were slower, as this processor has no instruction for them.",
    ),
    (
        "best_components",
        "Components of `best` at its full length",
        "Half of those of appearance. After 1,000 iterations they were not missed; at full length both scenes lose, so "
        "they stay.",
    ),
    (
        "best_faster",
        "What would make `best` faster",
        "Steps of 1.5 cells along the ray lose on both scenes. Narrower hidden layers save a fifth of the time and "
        "lose on lego; fewer iterations of more rays save more, and lose less.",
    ),
    (
        "best_cells",
        "Cells, harmonics, and the end of `best`",
        "Finer cells for the hull and the march and learning rates that fall less change less than seeds do; colour "
        "from spherical harmonics instead of a network loses.",
    ),
    (
        "best_pieces",
        "Pieces of `best` as it was",
        "An earlier `best`, with masks and 2,500 iterations in full, one piece left out at a time.",
    ),
    (
        "best_more",
        "More of `best`",
        "Without masks; one change at a time, and at last iterations that cost less, which it has now.",
    ),
    (
        "human_search",
        "`best` on bodies",
        "What the preset `human` was chosen from; PSNR alone, as validation has no meshes.",
    ),
    (
        "best_rates",
        "Learning rates of `best`",
        "As it was with masks and without distortion penalty; one run a row.",
    ),
    (
        "best_search",
        "Changes to `best`",
        "As it was then, one change at a time; what did not help stayed out.",
    ),
)

PICTURES = """
## What the pictures show


Made by `benchmarks/quality.py --keep` and `benchmarks/error_pictures.py`, and looked at; they show other people's
scenes, so they are not part of the project.

* lego, `tensorf` (r_144, 26.5 dB): the bucket's inside is too dark and flat, its rivets doubled; the grille is
  smeared. No haze, sharp outlines.
* lego, `few_tensorf` (the same view, 26.4 dB): the bucket's inside is blotched, light streaks of fog lie between
  the tracks and before the grille, a white cloud hangs under the front; in low views (r_72, r_80, r_120) a fringe
  of haze hangs below the ground plate, which no training view sees from the side. From behind and above (r_0, r_8,
  r_192) white specks lie on the ground. Seed 1 is alike (r_80, 22.3 dB; r_8, 22.8 dB): black and brown streaks on
  body and wheels, haze below the plate's front, grey ones behind its rear, white specks behind the bucket's arm. In
  seed 2 (r_80, 21.8 dB) there are more of them, in the air behind the cabin and before the bucket too.
* lego, masks as printed (the same view, 26.1 dB): as `few_tensorf`, the bucket's inside as blotched, a light smear in
  the grille. Settings of FourieRF (24.8 dB): pale all over, grainy, a veil above the bucket and before the tracks.
* lego, `best` (the same view, 29.1 dB): no fog and no haze. What is left: edges one pixel wide, the gaps of the
  tracks and of the grille, the inner wall of the bucket, a little soft. The worst views are the low ones from the
  side (r_80, 24.6 dB: wheels blurred, holes in beams filled, a faint haze below the plate) and the one from behind and
  above (24.3 dB).
* lego and chair with settings of SANeRF (r_144, 21.7 dB; the chair from 21.2 to 31.2 dB): the studs in lego's bucket
  are smeared into brown stripes, the cabin, the front and the tracks are torn; from behind and above (r_0, r_184) the
  cabin is patched with wrong colours. The chair's legs are eaten away or hang as loose specks beside it, there is a
  white gap between seat and back, and the back's plain side is streaked.
* lego, `few_tensorf_10k` (r_80, seed 2, 22.1 dB), from low at the side: wheels and body are blotched with black, brown
  fog hangs below the plate's front and specks behind its rear end, the bucket is mottled.
* chair, `tensorf` (r_152, 27.3 dB): closed, patterns readable, a little darker than it is. A green patch hangs above
  the chair in views from behind and above (r_0, r_168 to r_192): the rest of a wall right before a training camera.
* chair, `few_tensorf_10k` (the same view, 25.6 dB): no wall. White wood before the white background can be seen
  through: legs, armrests and the rim below the seat are frayed, most in views from the side (r_64 to r_80, 21.7 to
  22.6 dB). With an occlusion loss that counts 20 samples from the box, the front legs are eaten away as well.
* chair, `few_tensorf` (r_72, 21.9 dB, in seeds 1 and 2 alike; r_160, 24.0 dB): the rim below the seat and the edges
  of the seat are torn into streaks, front legs and armrests are grey and can be seen through; no wall.
* chair, masks as printed (r_112, 25.0 dB; r_72, 21.9 dB): the seat's green shows through the plain back, the rim below
  the seat hangs in strips, legs and armrests are frayed; no wall. Settings of FourieRF (r_64, 19.8 dB; r_112, 23.6 dB):
  seen from the side of no training view, the white wood is grey, brown and transparent, cloth shows through the back,
  and an edge of faint fog stands beside the chair, where the box ends.
* chair, `best` (r_72, 25.9 dB; r_152, 29.7 dB): upright, closed, patterns readable. The ornaments are blurred where
  they sit on thin wood, the shadow side of the legs is brownish and hazy, the armrest's cloth has lost its pattern, and
  seat and back are a little too bright all over: their sheen is seen from one direction by one training view.
* lego and chair, `quick` (r_144, 27.4 dB, and r_80, 21.9 dB; r_152, 28.1 dB): upright, colours right, blurred by about
  one stud. The bucket's inside is smeared; in the low view grey haze hangs below the plate, and wheels and tracks run
  together. The chair's ornaments and the cloth's pattern are soft, crumbs hang beside the left armrest; the streak of
  white at the seat's front edge that `best` has in this view is not there.
* chair and lego, `best-long` (r_72, 25.9 dB, and r_160, 27.7 dB; r_144, 29.8 dB, and r_72, 25.9 dB): the faults of
  `best`, fainter; on lego the studs on top, one pixel wide, and the line below the ground plate stand out.
* chair with `fewtensorf8` (r_152: `tensorf` 23.7, `few_tensorf_10k` 21.7, `best` 25.7 dB): from the front, where those
  views are few, `tensorf` mixes pattern and ground of the cloth into one mottled green, and legs and edges are frayed.
  `few_tensorf_10k` keeps more of the pattern, but armrests, front legs and the rim below the seat are torn to shreds
  that the white shows through, and so is the back's foot. `best` keeps pattern and wood; the rim and the right leg are
  broken, and the seat is too bright on its right.
* chair with `fewtensorf8`, `few_tensorf` (r_152, 21.3 dB): as `few_tensorf_10k`, and worse: the back's pattern is lost
  in brown, a torn streak of white lies across its foot, the rim below the seat is gone but for specks, legs fade.
* lego with `fewtensorf8` (r_128: `tensorf` 21.2, `few_tensorf_10k` 20.9, `best` 21.5 dB), from low, where no training
  view looks from: all three make the plate thicker than it is. Under it hang streaks of fog in `few_tensorf_10k`,
  specks in rows in `tensorf` and a faint haze in `best`. Wheels and front are blotched and bleached by `tensorf`,
  blotched by `few_tensorf_10k` and blurred by `best`.
* lego with `fewtensorf8`, `few_tensorf` (r_128, 21.1 dB): a comb of grey streaks and a black shred hang in the air
  below the plate, body and wheels are blotched with black and orange, crumbs hang before the bucket.
* lego and chair with `fewtensorf8`, `few_tensorf_finetuned` (r_128, 19.9 dB; r_152, 24.3 dB): below lego's plate hangs
  a fringe of haze in every low view, and brown specks around the bucket's teeth. The chair is whole from all sides, rim
  and legs too; from the front its pattern is blurred, and crumbs hang beside the left front leg.
* chair, `few_tensorf_finetuned` (r_152, 28.8 dB): legs and rim are whole, cloth and ornaments readable; the right edge
  of the back is grainy, specks hang between armrest and back.
* lego, `few_tensorf_finetuned` (r_144, 26.9 dB; r_80, 23.0 dB): plate, tracks and grille are cleaner than TensoRF's,
  the bucket's inside is as blotched, a tuft of brown fog hangs under a tooth. In low views a fringe of haze lies below
  the ground plate, in the part of the hull that no training view sees from the side.
* subject_a (0022: TensoRF 33.3, `few_tensorf_10k:few_tensorf_fixed` 30.3, `human` 36.2 dB): TensoRF smears the shirt's
  pocket, leaves a fringe between the legs and grey patches in the face. With masks fixed at 0.8 the white lines of the
  shirt are torn into dashes, face and trousers are blotched. `few_tensorf_finetuned` (36.5 dB) and `human`
  err at outlines; the former a little at the pocket and between the legs as well.
* subject_a and subject_b with 50 views, `tensorf` (39.1 to 41.8 and 36.2 to 38.7 dB): sharp all over; no fault can be
  seen in the sheets of all views.
* subject_a and subject_b, `few_tensorf_10k` with masks that open over the run (22.4 to 24.3 and 20.7 to 23.6 dB): the
  body is grey, and rags of mist hang around it. Colour has died: on subject_a the lines of appearance ended below 0.011
  everywhere, those of density reach 1 and more. Likely the penalty on their orthogonality did it, while they were
  hidden from the pictures.
* subject_b (0019: 30.8, 26.5, 32.5 dB): TensoRF puts wrong dots on the skirt where one view sees it, and a speck of fog
  floats beside it. With fixed masks the dots run into each other, stripes of the sleeves can be seen through, the
  speck is larger. `few_tensorf_finetuned` (32.0 dB) has TensoRF's wrong dots, fewer of them, and no fog. `human` has
  every dot; hem and hair are a little soft.
* subject_a and subject_b, `few_tensorf_finetuned`, seed 1, its worst views (0006, 31.8 dB; 0001, 28.6 dB): the shirt is
  smeared below the arms and its checks are out of line at the shoulders; the striped back is torn along its middle, the
  dots below that are wrong, and lilac crumbs hang under the hem. No fog. Seed 2 (0016, 32.2 dB; 0001, 27.7 dB) is
  alike, with a blue fringe on the trousers.
"""
