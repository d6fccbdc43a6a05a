// Drawing: base map, roads as ribbons, and squares at small zooms or if the user wants cells. Cells
// with only a lower bound are hollow, and unvisited cells are not drawn.
import { BORROWED, NO_NUMBER } from "./blocks.js";
import {
  HOLLOW,
  alertColour,
  fills,
  groundColour,
  inks,
  isKnownSlippery,
  themeName,
} from "./colours.js";
import { CELLS, CELL_LEVEL, TILES, metresPerWorld, worldX, worldY } from "./grid.js";
import { Pixels } from "./pixels.js";
import { ribbons, ribbonWidth, streets, track } from "./ribbons.js";
import { writeBeside } from "./vector.js";

const CORNER_PX = [60, 140]; // size of the buttons in the upper right corner
const NEAR_PX = 14;
const MOST_RECORDS = 9000;
const LEAST_RIBBON_ZOOM = 14.7;
const pixels = new Pixels();

/** Allocate the memory of a picture of a canvas's size before it is needed. */
export const reservePicture = canvas => pixels.reserve(canvas.width, canvas.height);

const hatches = {};
function hatching(pen) {
  if (hatches[themeName()]) return hatches[themeName()];
  const tile = document.createElement("canvas");
  tile.width = tile.height = 8;
  const ink = tile.getContext("2d");
  ink.strokeStyle = inks().hatch;
  ink.beginPath();
  ink.moveTo(0, 8);
  ink.lineTo(8, 0);
  ink.stroke();
  return (hatches[themeName()] = pen.createPattern(tile, "repeat"));
}

// Draw the map. Return the number of drawn places by kind, and whether roads were drawn as ribbons.
export function paint(pen, view, cells, extra) {
  const drawn = new Array(8).fill(0);
  const box = view.box;
  const near = view.scale / CELLS >= NEAR_PX;
  const passes = passing(extra);
  const seen = [...cells.tiles.values()].filter(
    ({ west, north }) =>
      west <= box.east &&
      north <= box.south &&
      west + 1 / TILES >= box.west &&
      north + 1 / TILES >= box.north,
  );
  const records = seen.reduce((sum, tile) => sum + tile.block.count, 0);
  const roads = extra.roads;
  const asRoads =
    Boolean(roads) &&
    view.zoom >= LEAST_RIBBON_ZOOM &&
    records <= MOST_RECORDS &&
    seen.every(tile => tile.block.level === CELL_LEVEL);
  const named = roads && !roads.learned;
  const below = extra.base || named || asRoads || extra.away.length || extra.route.length;
  if (below) {
    pen.fillStyle = groundColour();
    pen.fillRect(0, 0, view.width, view.height);
    extra.base?.paint(pen, view);
    if (named && !extra.base?.label && view.zoom >= LEAST_RIBBON_ZOOM - 2)
      streets(pen, view, roads);
    if (extra.route.length) corridor(pen, view, extra.route);
    for (const region of extra.away) regionAway(pen, view, region.box);
  }
  if (asRoads) {
    for (const alert of extra.alerts) halo(pen, view, tracesOf(view, alert, roads));
    const left = roads.lay(seen, passes, drawn, box);
    ribbons(pen, view, roads);
    for (const [tile, rows] of left) dots(pen, view, tile.parts, rows);
  } else {
    const parted = tile => near && tile.block.level === CELL_LEVEL;
    pixels.begin(pen.canvas.width, pen.canvas.height, pen.canvas.width / view.width, !below);
    for (const tile of seen) if (!parted(tile)) pixels.squares(view, tile.squares, passes, drawn);
    pixels.show(pen);
    for (const tile of seen) if (parted(tile)) headings(pen, view, tile.parts, passes, drawn);
    for (const alert of extra.alerts) halo(pen, view, tracesOf(view, alert, null));
  }
  if (extra.truth) truthDots(pen, view, extra.truth);
  const badges = extra.alerts.map(alert =>
    badgeAt(view, tracesOf(view, alert, asRoads ? roads : null)),
  );
  const placed = [
    ...badges.map(([x, y]) => [x, y + 5, 15, 21]),
    [view.width, 0, CORNER_PX[0], CORNER_PX[1]],
  ]; // no name is drawn over these places
  if (extra.base?.label) extra.base.label(pen, view, placed);
  else if (named) names(pen, view, roads, placed);
  badges.forEach((at, k) => badge(pen, at, k + 1));
  if (extra.route.length) stops(pen, view, extra.route);
  if (extra.chosen) mark(pen, view, extra.chosen);
  return { drawn, asRoads };
}

// Return a filter for the user's options; null if everything is shown. Known slippery places never
// count as mere bounds.
export const passing = extra =>
  extra.oldest === 0 && extra.bounds
    ? null
    : (rows, k) =>
        (extra.oldest === 0 || rows.last[k] >= extra.oldest) &&
        (extra.bounds || rows.mu[k] !== NO_NUMBER || isKnownSlippery(rows.slippery[k]));

// Corners of the triangle of each heading within the square: 0 east, 1 north, 2 west, 3 south.
export const SIDES = [
  [1, 0, 1, 1],
  [1, 0, 0, 0],
  [0, 0, 0, 1],
  [0, 1, 1, 1],
];

function triangle(pen, left, top, px, sector) {
  const [ax, ay, bx, by] = SIDES[sector];
  const cx = left + px / 2;
  const cy = top + px / 2;
  const inset = px * 0.04;
  const toward = (v, middle) => v + Math.sign(middle - v) * inset;
  pen.beginPath();
  pen.moveTo(cx + (ax + bx - 1) * inset, cy + (ay + by - 1) * inset);
  pen.lineTo(toward(left + ax * px, cx), toward(top + ay * px, cy));
  pen.lineTo(toward(left + bx * px, cx), toward(top + by * px, cy));
  pen.closePath();
}

function headings(pen, view, tile, passes, drawn) {
  const { rows, x, y, kind, side } = tile;
  const box = view.box;
  const shown = [];
  for (let k = 0; k < rows.count; k++) {
    if (
      x[k] > box.east ||
      x[k] + side < box.west ||
      y[k] > box.south ||
      y[k] + side < box.north ||
      (passes && !passes(rows, k))
    )
      continue;
    drawn[kind[k]]++;
    shown.push(k);
  }
  parts(pen, view, tile, shown);
}

// Draw the headings of cells: a triangle for each, or one square if they are too small.
function parts(pen, view, { rows, x, y, kind, side }, shown) {
  const px = side * view.scale;
  const colours = fills();
  const ink = inks();
  for (const k of shown) {
    const left = view.left(x[k]);
    const top = view.top(y[k]);
    if (px >= NEAR_PX) triangle(pen, left, top, px, rows.place[k] & 3);
    else {
      pen.beginPath();
      pen.rect(left + 0.5, top + 0.5, Math.max(2, px - 1), Math.max(2, px - 1));
    }
    if (kind[k] === HOLLOW) {
      pen.strokeStyle = ink.bound;
      pen.lineWidth = 1;
      pen.stroke();
      continue;
    }
    pen.fillStyle = colours[kind[k]];
    pen.fill();
    if (rows.basis[k] === BORROWED) {
      pen.strokeStyle = ink.text;
      pen.lineWidth = 1;
      pen.setLineDash([2, 2]);
      pen.stroke();
      pen.setLineDash([]);
    }
  }
}

// Draw cells that lie on no road of the map, such as a driveway.
function dots(pen, view, { x, y, kind, side }, shown) {
  const radius = Math.max(1.5, Math.min(6, ribbonWidth(view) * 0.3));
  const colours = fills();
  const ink = inks();
  for (const k of shown) {
    pen.beginPath();
    pen.arc(view.left(x[k] + side / 2), view.top(y[k] + side / 2), radius, 0, 2 * Math.PI);
    if (kind[k] === HOLLOW) {
      pen.strokeStyle = ink.bound;
      pen.lineWidth = 1;
      pen.stroke();
      continue;
    }
    pen.fillStyle = colours[kind[k]];
    pen.fill();
  }
}

function regionAway(pen, view, [west, south, east, north]) {
  const left = view.left(worldX(west));
  const top = view.top(worldY(north));
  const right = view.left(worldX(east));
  const bottom = view.top(worldY(south));
  pen.fillStyle = hatching(pen);
  pen.fillRect(left, top, right - left, bottom - top);
  pen.strokeStyle = inks().bound;
  pen.lineWidth = 2;
  pen.strokeRect(left, top, right - left, bottom - top);
}

// Return the lines on which an alert is drawn: along the ribbons of its lanes, or else from cell to
// cell.
function tracesOf(view, alert, roads) {
  const found = roads
    ? roads.under(alert).map(({ lane, first, end }) => {
        const [left, top] = track(view, roads, lane);
        return Array.from({ length: end - first + 1 }, (_, k) => [left(first + k), top(first + k)]);
      })
    : [];
  if (found.length) return found.sort((a, b) => b.length - a.length);
  return [
    alert.points?.length
      ? alert.points.map(([latitude, longitude]) => [
          view.left(worldX(longitude)),
          view.top(worldY(latitude)),
        ])
      : [middle(view, alert)],
  ];
}

// Draw a wide outline around the ribbons of an alert; its number in the list is drawn beside it.
function halo(pen, view, traces) {
  const width = Math.max(18, 2.6 * ribbonWidth(view));
  const path = new Path2D();
  for (const points of traces) {
    points.forEach(([x, y], k) => (k ? path.lineTo(x, y) : path.moveTo(x, y)));
    if (points.length === 1) path.lineTo(points[0][0] + 0.01, points[0][1]);
  }
  pen.lineJoin = pen.lineCap = "round";
  for (const [wide, ink] of [
    [width + 6, alertColour()],
    [width, groundColour()],
  ]) {
    pen.lineWidth = wide;
    pen.strokeStyle = ink;
    pen.stroke(path);
  }
  pen.globalAlpha = 0.16;
  pen.strokeStyle = alertColour();
  pen.stroke(path);
  pen.globalAlpha = 1;
  pen.lineCap = "butt";
}

const middle = (view, { bbox: [west, south, east, north] }) => [
  view.left(worldX((west + east) / 2)),
  view.top((worldY(south) + worldY(north)) / 2),
];

// Return the position of an alert's badge: above the middle of its longest line.
function badgeAt(view, [points]) {
  const [x, y] = points[points.length >> 1];
  return [x, y - Math.max(18, 2.6 * ribbonWidth(view)) * 0.5 - 16];
}

function badge(pen, [x, y], number) {
  pen.beginPath();
  pen.moveTo(x, y + 18);
  pen.arc(x, y, 12, 0.8, Math.PI - 0.8, true);
  pen.closePath();
  for (const [paintIt, ink, wide] of [
    ["stroke", groundColour(), 4],
    ["fill", alertColour(), 0],
  ]) {
    pen.lineWidth = wide;
    pen[`${paintIt}Style`] = ink;
    pen[paintIt]();
  }
  pen.font = "700 13px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillStyle = themeName() === "dark" ? "#000000" : "#ffffff";
  pen.fillText(String(number), x, y + 0.5);
}

// Draw road names where no base map has them.
function names(pen, view, roads, placed) {
  const said = new Set();
  const ink = inks();
  if (view.zoom < LEAST_RIBBON_ZOOM) return;
  for (const line of roads.lines) {
    if (!line.name || said.has(line.name)) continue;
    const at = Math.floor(line.count / 2);
    const step = Math.min(4, line.count - at);
    const a = [view.left(line.x[at]), view.top(line.y[at])];
    const b = [view.left(line.x[at + step]), view.top(line.y[at + step])];
    if (
      !step ||
      a[0] < 0 ||
      a[1] < 0 ||
      a[0] > view.width ||
      a[1] > view.height ||
      line.length * view.scale < line.name.length * 7
    )
      continue;
    const off = ribbonWidth(view) * 1.6 + 9;
    if (writeBeside(pen, ink, line.name, a, a, b, off, 12.5, placed, view)) said.add(line.name);
  }
}

// Draw a route as a wide band. It is drawn below the cells, so that it hides none of them.
function corridor(pen, view, points) {
  const px = Math.max(10, 2.6 * ribbonWidth(view));
  pen.lineJoin = pen.lineCap = "round";
  pen.beginPath();
  for (const [longitude, latitude] of points)
    pen.lineTo(view.left(worldX(longitude)), view.top(worldY(latitude)));
  for (const [width, ink] of [
    [px + 5, inks().route],
    [px, groundColour()],
  ]) {
    pen.lineWidth = width;
    pen.strokeStyle = ink;
    pen.stroke();
  }
  pen.lineCap = "butt";
}

function stops(pen, view, points) {
  pen.fillStyle = inks().route;
  for (const [longitude, latitude] of points.length <= 60 ? points : [points[0], points.at(-1)]) {
    pen.beginPath();
    pen.arc(view.left(worldX(longitude)), view.top(worldY(latitude)), 5, 0, 2 * Math.PI);
    pen.fill();
  }
}

function mark(pen, view, { x, y, side }) {
  const px = Math.max(side * view.scale, 10);
  const cx = view.left(x + side / 2);
  const cy = view.top(y + side / 2);
  for (const [wide, ink] of [
    [5, groundColour()],
    [2.5, inks().route],
  ]) {
    pen.lineWidth = wide;
    pen.strokeStyle = ink;
    pen.strokeRect(cx - px / 2 - 2, cy - px / 2 - 2, px + 4, px + 4);
  }
}

function truthDots(pen, view, truth) {
  const px = view.scale / CELLS;
  const radius = Math.min(7, Math.max(1.5, px * 0.16));
  const colours = fills();
  for (const { x, y, sector, kind } of truth) {
    const side = 1 / CELLS;
    const [ax, ay, bx, by] = SIDES[sector];
    const left = view.left(x + side * (0.5 + (ax + bx - 1) * 0.3));
    const top = view.top(y + side * (0.5 + (ay + by - 1) * 0.3));
    if (left < -9 || top < -9 || left > view.width + 9 || top > view.height + 9) continue;
    pen.beginPath();
    pen.arc(left, top, radius, 0, 2 * Math.PI);
    pen.fillStyle = colours[kind];
    pen.fill();
    pen.strokeStyle = inks().text;
    pen.lineWidth = 1;
    pen.stroke();
  }
}

export function scaleBar(element, view, text) {
  const metre = view.scale / metresPerWorld(view.y);
  const tens = 10 ** Math.floor(Math.log10(120 / metre));
  const metres = [5, 2, 1].map(k => k * tens).find(m => m * metre <= 120);
  const words =
    metres >= 1000
      ? text("scale.kilometres", { n: metres / 1000 })
      : text("scale.metres", { n: metres });
  element.style.width = `${metres * metre}px`;
  if (element.textContent !== words) element.textContent = words;
}
