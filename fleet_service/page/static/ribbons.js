// Drawing of roads: the street, then a ribbon for each direction. The ribbon is wide where the
// friction is well known, narrower where it is roughly known, and thin and grey or hollow where it
// is unknown.
import { DANGER, HOLLOW, LITTLE, fills, groundColour, inks } from "./colours.js";
import { metresPerWorld } from "./grid.js";
import { isNone } from "./roads.js";

const LANE_M = 3.4;
const SHARE = [1, 1, 1, 1, 0.7, 0.7, 0.34, 0.34];
const ARROW_PX = 110;
const ARROWS_PX = 9;
const SIDEWAYS = 0.56;
// Kinds with too little contrast to the ground without an edge (WCAG 1.4.11 demands 3 : 1).
const EDGED = [2, 3, 5, 6];

export function ribbonWidth(view) {
  return Math.max(4.5, Math.min(26, (LANE_M * view.scale) / metresPerWorld(view.y)));
}

// Return the sideways shift [m] of a lane from the middle of its road, which both directions share.
export const sidewaysOf = view =>
  (SIDEWAYS * ribbonWidth(view) * metresPerWorld(view.y)) / view.scale;

export function track(view, roads, lane) {
  const off = lane.both || roads.learned ? SIDEWAYS * ribbonWidth(view) : 0;
  return [
    i => view.left(lane.x[i]) + lane.nx[i] * off,
    i => view.top(lane.y[i]) + lane.ny[i] * off,
  ];
}

const inView = (lane, box, pad) =>
  lane.west - pad <= box.east &&
  lane.east + pad >= box.west &&
  lane.north - pad <= box.south &&
  lane.south + pad >= box.north;

// Draw the streets of the road map if no base map draws them.
export function streets(pen, view, roads) {
  const width = 2 * ribbonWidth(view) + 5;
  const ink = inks();
  const path = new Path2D();
  const pad = 30 / view.scale;
  const box = view.box;
  for (const line of roads.lines) {
    for (let i = 0; i <= line.count; i++) {
      const x = view.left(line.x[i]);
      const y = view.top(line.y[i]);
      if (i) path.lineTo(x, y);
      else path.moveTo(x, y);
    }
  }
  pen.lineJoin = pen.lineCap = "round";
  for (const [wide, colour] of [
    [width + 2, ink.edge],
    [width, ink.road],
  ]) {
    pen.lineWidth = wide;
    pen.strokeStyle = colour;
    pen.stroke(path);
  }
  return { pad, box };
}

export function ribbons(pen, view, roads) {
  const wide = ribbonWidth(view);
  const ground = groundColour();
  const ink = inks();
  const colours = fills();
  const paths = DANGER.map(() => new Path2D());
  const box = view.box;
  const pad = 40 / view.scale;
  const arrows = [];
  for (const lane of roads.lanes) {
    if (!lane.any || !inView(lane, box, pad)) continue;
    const [left, top] = track(view, roads, lane);
    for (let i = 0; i < lane.count; i++) {
      const kind = lane.kind[i];
      if (isNone(kind)) continue;
      const path = paths[kind];
      let end = i;
      while (end < lane.count && lane.kind[end] === kind) end++;
      path.moveTo(left(i), top(i));
      for (let k = i + 1; k <= end; k++) path.lineTo(left(k), top(k));
      if (wide > ARROWS_PX && kind < LITTLE) mark(arrows, lane, left, top, i, end, kind);
      i = end - 1;
    }
  }
  pen.lineJoin = "round";
  pen.lineCap = "butt";
  const line = (kind, width, colour) => {
    pen.lineWidth = width;
    pen.strokeStyle = colour;
    pen.stroke(paths[kind]);
  };
  line(HOLLOW, Math.max(3, wide * SHARE[HOLLOW]), ink.bound);
  line(HOLLOW, Math.max(1.2, wide * SHARE[HOLLOW] - 2.2), ground);
  line(LITTLE, Math.max(3, wide * SHARE[LITTLE]), ink.bound);
  line(LITTLE, Math.max(1.2, wide * SHARE[LITTLE] - 2.2), colours[LITTLE]);
  pen.lineCap = "round";
  for (const kind of [...DANGER].reverse())
    if (kind < LITTLE)
      line(kind, wide * SHARE[kind] + 2, EDGED.includes(kind) ? ink.bound : ink.casing);
  for (const kind of [...DANGER].reverse())
    if (kind < LITTLE) line(kind, wide * SHARE[kind], colours[kind]);
  pen.lineCap = "butt";
  for (const [x, y, ax, ay, kind] of arrows)
    arrow(pen, x, y, ax, ay, wide * 0.26, contrastOf(colours[kind]));
}

function mark(arrows, lane, left, top, first, end, kind) {
  let run = ARROW_PX * 0.5;
  for (let k = first; k < end; k++) {
    const dx = left(k + 1) - left(k);
    const dy = top(k + 1) - top(k);
    const size = Math.hypot(dx, dy);
    run += size;
    if (run >= ARROW_PX && size) {
      arrows.push([left(k), top(k), dx / size, dy / size, kind]);
      run = 0;
    }
  }
}

function arrow(pen, x, y, ax, ay, size, colour) {
  pen.beginPath();
  pen.moveTo(x - ax * size - ay * size, y - ay * size + ax * size);
  pen.lineTo(x + ax * size * 0.6, y + ay * size * 0.6);
  pen.lineTo(x - ax * size + ay * size, y - ay * size - ax * size);
  pen.lineWidth = Math.max(1.5, size * 0.45);
  pen.strokeStyle = colour;
  pen.stroke();
}

const contrastOf = colour => {
  const [r, g, b] = [1, 3, 5].map(k => parseInt(colour.slice(k, k + 2), 16));
  return 0.3 * r + 0.59 * g + 0.11 * b > 130 ? "#00000099" : "#ffffffcc";
};
