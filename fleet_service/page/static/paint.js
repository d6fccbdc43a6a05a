// Drawing: squares where the map is far, four headings to a square where it is near; a bound is hollow, nobody is nothing.
import { BORROWED } from "./blocks.js";
import { HOLLOW, alertColour, fills, groundColour } from "./colours.js";
import { CELLS, CELL_LEVEL, TILES, metresPerWorld, worldX, worldY } from "./grid.js";
import { Pixels } from "./pixels.js";

const NEAR_PX = 14, pixels = new Pixels();
const BOUND_INK = "#7d7d7d", TRUTH_INK = "#000000", ROUTE_INK = "#0a4fb3";

let hatch = null;
function hatching(pen) {
  if (hatch) return hatch;
  const tile = document.createElement("canvas");
  tile.width = tile.height = 8;
  const ink = tile.getContext("2d");
  ink.strokeStyle = "#b9b9b9";
  ink.beginPath(); ink.moveTo(0, 8); ink.lineTo(8, 0); ink.stroke();
  return hatch = pen.createPattern(tile, "repeat");
}

// Returns how many places were drawn, by kind.
export function paint(pen, view, cells, extra) {
  const drawn = new Array(8).fill(0), box = view.box, near = view.scale / CELLS >= NEAR_PX, passes = passing(extra);
  const seen = [...cells.tiles.values()].filter(({ west, north }) =>
    west <= box.east && north <= box.south && west + 1 / TILES >= box.west && north + 1 / TILES >= box.north);
  const parted = tile => near && tile.block.level === CELL_LEVEL, below = extra.base || extra.away.length || extra.route.length;
  if (below) {
    pen.fillStyle = groundColour();
    pen.fillRect(0, 0, view.width, view.height);
    extra.base?.paint(pen, view);
    if (extra.route.length) corridor(pen, view, extra.route);
    for (const region of extra.away) regionAway(pen, view, region.box);
  }
  pixels.begin(pen.canvas.width, pen.canvas.height, pen.canvas.width / view.width, !below);
  for (const tile of seen) if (!parted(tile)) pixels.squares(view, tile.squares, passes, drawn);
  pixels.show(pen);
  for (const tile of seen) if (parted(tile)) headings(pen, view, tile.parts, passes, drawn);
  if (extra.truth) truthDots(pen, view, extra.truth);
  for (const alert of extra.alerts) ring(pen, view, alert);
  if (extra.route.length) stops(pen, view, extra.route);
  if (extra.chosen) mark(pen, view, extra.chosen);
  return drawn;
}

// What a person asked to see, or null: all.
const passing = extra => extra.oldest === 0 && extra.bounds ? null : (rows, k) => (extra.oldest === 0 || rows.last[k] >= extra.oldest) && (extra.bounds || rows.mu[k] !== 255);

// 0 east, 1 north, 2 west, 3 south: the triangle on that side of the square.
export const SIDES = [[1, 0, 1, 1], [1, 0, 0, 0], [0, 0, 0, 1], [0, 1, 1, 1]];

function headings(pen, view, { rows, x, y, kind, side }, passes, drawn) {
  const px = side * view.scale, colours = fills(), box = view.box;
  for (let k = 0; k < rows.count; k++) {
    if (x[k] > box.east || x[k] + side < box.west || y[k] > box.south || y[k] + side < box.north || passes && !passes(rows, k)) continue;
    const left = view.left(x[k]), top = view.top(y[k]), [ax, ay, bx, by] = SIDES[rows.place[k] & 3];
    drawn[kind[k]]++;
    const cx = left + px / 2, cy = top + px / 2, inset = px * .04, toward = (v, middle) => v + Math.sign(middle - v) * inset;
    pen.beginPath();
    pen.moveTo(cx + (ax + bx - 1) * inset, cy + (ay + by - 1) * inset);
    pen.lineTo(toward(left + ax * px, cx), toward(top + ay * px, cy));
    pen.lineTo(toward(left + bx * px, cx), toward(top + by * px, cy));
    pen.closePath();
    if (kind[k] === HOLLOW) {
      pen.strokeStyle = BOUND_INK; pen.lineWidth = 1; pen.stroke();
      continue;
    }
    pen.fillStyle = colours[kind[k]];
    pen.fill();
    if (rows.basis[k] === BORROWED) { pen.strokeStyle = TRUTH_INK; pen.lineWidth = 1; pen.setLineDash([2, 2]); pen.stroke(); pen.setLineDash([]); }
  }
}

function regionAway(pen, view, [west, south, east, north]) {
  const left = view.left(worldX(west)), top = view.top(worldY(north)), right = view.left(worldX(east)), bottom = view.top(worldY(south));
  pen.fillStyle = hatching(pen);
  pen.fillRect(left, top, right - left, bottom - top);
  pen.strokeStyle = "#8a8a8a";
  pen.lineWidth = 2;
  pen.strokeRect(left, top, right - left, bottom - top);
}

function ring(pen, view, { bbox: [west, south, east, north] }) {
  const middle = [view.left(worldX((west + east) / 2)), view.top((worldY(south) + worldY(north)) / 2)];
  const half = [worldX(east) - worldX(west), worldY(south) - worldY(north)].map(size => Math.max(11, size / 2 * view.scale + 8));
  pen.beginPath();
  pen.roundRect(middle[0] - half[0], middle[1] - half[1], 2 * half[0], 2 * half[1], Math.min(...half));
  for (const [width, ink] of [[6, "#ffffff"], [3, alertColour()]]) { pen.lineWidth = width; pen.strokeStyle = ink; pen.stroke(); }
}

// Along a route, below the cells: as broad as they are, so that none is hidden.
function corridor(pen, view, points) {
  const px = Math.max(8, 1.3 * view.scale / CELLS);
  pen.lineJoin = pen.lineCap = "round";
  pen.beginPath();
  for (const [longitude, latitude] of points) pen.lineTo(view.left(worldX(longitude)), view.top(worldY(latitude)));
  for (const [width, ink] of [[px + 5, ROUTE_INK], [px, groundColour()]]) { pen.lineWidth = width; pen.strokeStyle = ink; pen.stroke(); }
  pen.lineCap = "butt";
}

function stops(pen, view, points) {
  pen.fillStyle = ROUTE_INK;
  for (const [longitude, latitude] of points.length <= 60 ? points : [points[0], points.at(-1)]) {
    pen.beginPath();
    pen.arc(view.left(worldX(longitude)), view.top(worldY(latitude)), 5, 0, 2 * Math.PI);
    pen.fill();
  }
}

function mark(pen, view, { x, y, side }) {
  pen.lineWidth = 3; pen.strokeStyle = ROUTE_INK;
  const px = Math.max(side * view.scale, 8), middle = .5 * (px - side * view.scale);
  pen.strokeRect(view.left(x) - middle - 2, view.top(y) - middle - 2, px + 4, px + 4);
}

function truthDots(pen, view, truth) {
  const px = view.scale / CELLS, radius = Math.min(7, Math.max(1.5, px * .16)), colours = fills();
  for (const { x, y, sector, kind } of truth) {
    const side = 1 / CELLS, [ax, ay, bx, by] = SIDES[sector];
    const left = view.left(x + side * (.5 + (ax + bx - 1) * .3)), top = view.top(y + side * (.5 + (ay + by - 1) * .3));
    if (left < -9 || top < -9 || left > view.width + 9 || top > view.height + 9) continue;
    pen.beginPath();
    pen.arc(left, top, radius, 0, 2 * Math.PI);
    pen.fillStyle = colours[kind];
    pen.fill();
    if (px >= NEAR_PX) { pen.strokeStyle = TRUTH_INK; pen.lineWidth = 1; pen.stroke(); }
  }
}

export function scaleBar(element, view, text) {
  const metre = view.scale / metresPerWorld(view.y), tens = 10 ** Math.floor(Math.log10(120 / metre));
  const metres = [5, 2, 1].map(k => k * tens).find(m => m * metre <= 120);
  const words = metres >= 1000 ? text("scale.kilometres", { n: metres / 1000 }) : text("scale.metres", { n: metres });
  element.style.width = `${metres * metre}px`;
  if (element.textContent !== words) element.textContent = words;
}
