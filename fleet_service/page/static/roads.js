// Roads as ribbons: lines cut into pieces, each direction with the most dangerous of the records that lie on it.
import { CELLS, columnOf, metresPerWorld, rowOf, worldX, worldY } from "./grid.js";
import { rankOf } from "./colours.js";

const PIECE_M = 8, REACH_M = 24, LEAST_COS = .3, NONE = 255, BRIDGED = 2;
const WAYS = [[1, 0], [0, -1], [-1, 0], [0, 1]];  // of the headings, x to the east and y to the south
const keyOf = (column, row) => row * CELLS + column;

// A line in equal pieces: points and unit normals to its right, in parts of the world.
function cut(points) {
  const xs = points.map(point => worldX(point[0])), ys = points.map(point => worldY(point[1])), metre = 1 / metresPerWorld(ys[0]), run = [0];
  for (let k = 1; k < xs.length; k++) run.push(run[k - 1] + Math.hypot(xs[k] - xs[k - 1], ys[k] - ys[k - 1]));
  const length = run.at(-1), count = Math.max(1, Math.round(length / (PIECE_M * metre))), x = new Float64Array(count + 1), y = new Float64Array(count + 1);
  for (let i = 0, k = 1; i <= count; i++) {
    const at = length * i / count;
    while (k < run.length - 1 && run[k] < at) k++;
    const share = run[k] > run[k - 1] ? (at - run[k - 1]) / (run[k] - run[k - 1]) : 0;
    x[i] = xs[k - 1] + share * (xs[k] - xs[k - 1]);
    y[i] = ys[k - 1] + share * (ys[k] - ys[k - 1]);
  }
  return { x, y, count, length };
}

// One direction of a line.
function laneOf({ x, y, count, length }, name, backward) {
  const lane = { name, count, length, x: new Float64Array(count + 1), y: new Float64Array(count + 1), nx: new Float64Array(count + 1), ny: new Float64Array(count + 1), kind: new Uint8Array(count).fill(NONE), records: new Array(count).fill(null) };
  for (let i = 0; i <= count; i++) { const from = backward ? count - i : i; lane.x[i] = x[from]; lane.y[i] = y[from]; }
  for (let i = 0; i <= count; i++) {
    const a = Math.max(0, i - 1), b = Math.min(count, i + 1), dx = lane.x[b] - lane.x[a], dy = lane.y[b] - lane.y[a], size = Math.hypot(dx, dy) || 1;
    lane.nx[i] = -dy / size;
    lane.ny[i] = dx / size;
  }
  lane.west = Math.min(...lane.x); lane.east = Math.max(...lane.x); lane.north = Math.min(...lane.y); lane.south = Math.max(...lane.y);
  return lane;
}

export class Roads {
  constructor({ lines, places, learned }) {
    this.learned = learned;
    this.places = places.map(([name, longitude, latitude]) => ({ name, longitude, latitude }));
    this.lines = lines.map(line => ({ ...line, ...cut(line.points) }));
    this.lanes = this.lines.flatMap(line => [1, 2].filter(way => line.directions & way).map(way => ({ ...laneOf(line, line.name, way === 2), line, both: line.directions === 3 })));
    this.byCell = new Map();
    this.lanes.forEach((lane, number) => {
      for (let i = 0; i < lane.count; i++) {
        const key = keyOf(Math.floor((lane.x[i] + lane.x[i + 1]) / 2 * CELLS), Math.floor((lane.y[i] + lane.y[i + 1]) / 2 * CELLS));
        if (!this.byCell.has(key)) this.byCell.set(key, []);
        this.byCell.get(key).push([number, i]);
      }
    });
    this.found = new Map();  // of a cell and heading: its lane and piece, looked up once
  }

  get names() { return [...new Set(this.lines.map(line => line.name).filter(Boolean))].sort(); }

  // Lane and piece of a record; null where no road is near.
  pieceOf(column, row, sector) {
    const key = keyOf(column, row) * 4 + sector, known = this.found.get(key);
    if (known !== undefined) return known;
    const x = (column + .5) / CELLS, y = (row + .5) / CELLS, reach = REACH_M / metresPerWorld(y), [wx, wy] = WAYS[sector];
    let best = null, least = reach;
    for (let dx = -2; dx <= 2; dx++) for (let dy = -2; dy <= 2; dy++)
      for (const [number, i] of this.byCell.get(keyOf(column + dx, row + dy)) ?? []) {
        const lane = this.lanes[number], cos = lane.ny[i] * wx - lane.nx[i] * wy;
        if (cos < LEAST_COS) continue;
        const far = Math.hypot((lane.x[i] + lane.x[i + 1]) / 2 - x, (lane.y[i] + lane.y[i + 1]) / 2 - y) + (1 - cos) * reach * .3;
        if (far < least) { least = far; best = [number, i]; }
      }
    this.found.set(key, best);
    return best;
  }

  // Lay the records of tiles upon the lanes; what lies on no road comes back, tile by tile, as row numbers.
  lay(tiles, passes, drawn, box) {
    for (const lane of this.lanes) { lane.kind.fill(NONE); lane.any = false; }
    const left = [];
    for (const tile of tiles) {
      const { rows, x, y, kind, side } = tile.parts, column = columnOf(tile.block.tile) * 128, row = rowOf(tile.block.tile) * 128, rest = [];
      for (let k = 0; k < rows.count; k++) {
        if (passes && !passes(rows, k)) continue;
        if (x[k] <= box.east && x[k] + side >= box.west && y[k] <= box.south && y[k] + side >= box.north) drawn[kind[k]]++;
        const local = rows.place[k] >> 2, at = this.pieceOf(column + columnOf(local), row + rowOf(local), rows.place[k] & 3);
        if (!at) { rest.push(k); continue; }
        const lane = this.lanes[at[0]], held = lane.kind[at[1]];
        lane.any = true;
        if (held === NONE || rankOf(kind[k]) < rankOf(held)) lane.kind[at[1]] = kind[k];
      }
      if (rest.length) left.push([tile, rest]);
    }
    for (const lane of this.lanes) if (lane.any) bridge(lane);
    return left;
  }

  // The road nearest to a point, within a distance: its name and direction of travel there.
  nearest(x, y, within = 40) {
    const column = Math.floor(x * CELLS), row = Math.floor(y * CELLS), most = Math.ceil(within / 8);
    let best = null, least = within / metresPerWorld(y);
    for (let dx = -most; dx <= most; dx++) for (let dy = -most; dy <= most; dy++)
      for (const [number, i] of this.byCell.get(keyOf(column + dx, row + dy)) ?? []) {
        const lane = this.lanes[number], far = Math.hypot(lane.x[i] - x, lane.y[i] - y);
        if (lane.name && far < least) { least = far; best = lane; }
      }
    return best?.name ?? "";
  }

  // Where a road lies, for the search.
  extentOf(name) {
    const own = this.lanes.filter(lane => lane.name === name);
    return { west: Math.min(...own.map(l => l.west)), east: Math.max(...own.map(l => l.east)), north: Math.min(...own.map(l => l.north)), south: Math.max(...own.map(l => l.south)) };
  }
}

// A gap of a piece or two between two pieces with records is the width of a cell, not an unknown road.
function bridge({ kind }) {
  for (let i = 0; i < kind.length; i++) {
    if (kind[i] !== NONE || i === 0 || kind[i - 1] === NONE) continue;
    let end = i;
    while (end < kind.length && kind[end] === NONE) end++;
    if (end < kind.length && end - i <= BRIDGED) for (let k = i; k < end; k++) kind[k] = k - i < end - 1 - k ? kind[i - 1] : kind[end];
    i = end;
  }
}

export const isNone = kind => kind === NONE;
