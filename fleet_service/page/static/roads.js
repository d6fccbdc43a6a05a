// Roads as ribbons: lines are cut into pieces. For each direction, a piece shows its most dangerous
// record.
import {
  CELLS,
  HEADINGS,
  cellAt,
  columnOf,
  metresPerWorld,
  rowOf,
  worldX,
  worldY,
} from "./grid.js";
import { kindOf, rankOf } from "./colours.js";

const PIECE_M = 8;
const REACH_M = 24;
const LEAST_COS = 0.3;
const NONE = 255;
const BRIDGED = 2;
const LINKED = 5;
export const WAYS = [
  [1, 0],
  [0, -1],
  [-1, 0],
  [0, 1],
]; // direction of each heading: x to the east, y to the south
const keyOf = (column, row) => row * CELLS + column;

// Cut a line into equal pieces. Return points and unit normals to the right, in coordinates from 0
// to 1.
function cut(points) {
  const xs = points.map(point => worldX(point[0]));
  const ys = points.map(point => worldY(point[1]));
  const metre = 1 / metresPerWorld(ys[0]);
  const run = [0];
  for (let k = 1; k < xs.length; k++)
    run.push(run[k - 1] + Math.hypot(xs[k] - xs[k - 1], ys[k] - ys[k - 1]));
  const length = run.at(-1);
  const count = Math.max(1, Math.round(length / (PIECE_M * metre)));
  const x = new Float64Array(count + 1);
  const y = new Float64Array(count + 1);
  for (let i = 0, k = 1; i <= count; i++) {
    const at = (length * i) / count;
    while (k < run.length - 1 && run[k] < at) k++;
    const share = run[k] > run[k - 1] ? (at - run[k - 1]) / (run[k] - run[k - 1]) : 0;
    x[i] = xs[k - 1] + share * (xs[k] - xs[k - 1]);
    y[i] = ys[k - 1] + share * (ys[k] - ys[k - 1]);
  }
  return { x, y, count, length };
}

// Return one direction of a line.
function laneOf({ x, y, count, length }, name, backward) {
  const lane = {
    name,
    count,
    length,
    x: new Float64Array(count + 1),
    y: new Float64Array(count + 1),
    nx: new Float64Array(count + 1),
    ny: new Float64Array(count + 1),
    kind: new Uint8Array(count).fill(NONE),
    records: new Array(count).fill(null),
    any: false,
  };
  for (let i = 0; i <= count; i++) {
    const from = backward ? count - i : i;
    lane.x[i] = x[from];
    lane.y[i] = y[from];
  }
  for (let i = 0; i <= count; i++) {
    const a = Math.max(0, i - 1);
    const b = Math.min(count, i + 1);
    const dx = lane.x[b] - lane.x[a];
    const dy = lane.y[b] - lane.y[a];
    const size = Math.hypot(dx, dy) || 1;
    lane.nx[i] = -dy / size;
    lane.ny[i] = dx / size;
  }
  lane.west = Math.min(...lane.x);
  lane.east = Math.max(...lane.x);
  lane.north = Math.min(...lane.y);
  lane.south = Math.max(...lane.y);
  return lane;
}

export class Roads {
  constructor({ lines, places, learned }) {
    this.learned = learned;
    this.places = places.map(([name, longitude, latitude]) => ({ name, longitude, latitude }));
    this.lines = lines.map(line => ({ ...line, ...cut(line.points) }));
    this.lanes = this.lines.flatMap(line =>
      [1, 2]
        .filter(way => line.directions & way)
        .map(way => ({ ...laneOf(line, line.name, way === 2), line, both: line.directions === 3 })),
    );
    this.byCell = new Map();
    this.lanes.forEach((lane, number) => {
      for (let i = 0; i < lane.count; i++) {
        const key = keyOf(
          Math.floor(((lane.x[i] + lane.x[i + 1]) / 2) * CELLS),
          Math.floor(((lane.y[i] + lane.y[i + 1]) / 2) * CELLS),
        );
        if (!this.byCell.has(key)) this.byCell.set(key, []);
        this.byCell.get(key).push([number, i]);
      }
    });
    this.found = new Map(); // cache: lane and piece of a cell and heading
  }

  get names() {
    return [...new Set(this.lines.map(line => line.name).filter(Boolean))].sort();
  }

  // Return lane and piece of a record; null if no road is near.
  pieceOf(column, row, sector) {
    const key = keyOf(column, row) * 4 + sector;
    const known = this.found.get(key);
    if (known !== undefined) return known;
    const x = (column + 0.5) / CELLS;
    const y = (row + 0.5) / CELLS;
    const reach = REACH_M / metresPerWorld(y);
    const [wx, wy] = WAYS[sector];
    let best = null;
    let least = reach;
    for (let dx = -2; dx <= 2; dx++)
      for (let dy = -2; dy <= 2; dy++)
        for (const [number, i] of this.byCell.get(keyOf(column + dx, row + dy)) ?? []) {
          const lane = this.lanes[number];
          const cos = lane.ny[i] * wx - lane.nx[i] * wy;
          if (cos < LEAST_COS) continue;
          const far =
            Math.hypot((lane.x[i] + lane.x[i + 1]) / 2 - x, (lane.y[i] + lane.y[i + 1]) / 2 - y) +
            (1 - cos) * reach * 0.3;
          if (far < least) {
            least = far;
            best = [number, i];
          }
        }
    this.found.set(key, best);
    return best;
  }

  // Assign the records of tiles to lanes. Return the row numbers of the remaining records, tile by
  // tile.
  lay(tiles, passes, drawn, box) {
    for (const lane of this.lanes) {
      lane.kind.fill(NONE);
      lane.records.fill(null);
      lane.any = false;
    }
    const left = [];
    for (const tile of tiles) {
      const { rows, x, y, kind, side } = tile.parts;
      const column = columnOf(tile.block.tile) * 128;
      const row = rowOf(tile.block.tile) * 128;
      const rest = [];
      for (let k = 0; k < rows.count; k++) {
        if (passes && !passes(rows, k)) continue;
        if (
          x[k] <= box.east &&
          x[k] + side >= box.west &&
          y[k] <= box.south &&
          y[k] + side >= box.north
        )
          drawn[kind[k]]++;
        const local = rows.place[k] >> 2;
        const at = this.pieceOf(column + columnOf(local), row + rowOf(local), rows.place[k] & 3);
        if (!at) {
          rest.push(k);
          continue;
        }
        const lane = this.lanes[at[0]];
        const held = lane.kind[at[1]];
        lane.any = true;
        if (held === NONE || rankOf(kind[k]) < rankOf(held)) {
          lane.kind[at[1]] = kind[k];
          lane.records[at[1]] = { tile, k };
        }
      }
      if (rest.length) left.push([tile, rest]);
    }
    for (const lane of this.lanes) if (lane.any) bridge(lane);
    return left;
  }

  // Return the pieces of lanes under an alert as runs of neighbours: { lane, first, end }.
  under(alert) {
    const pieces = new Map();
    const found = [];
    for (const [latitude, longitude] of alert.points ?? [])
      for (const heading of alert.headings) {
        const at = this.pieceOf(
          Math.floor(worldX(longitude) * CELLS),
          Math.floor(worldY(latitude) * CELLS),
          HEADINGS.indexOf(heading),
        );
        if (at) pieces.set(at[0], [...(pieces.get(at[0]) ?? []), at[1]]);
      }
    for (const [number, own] of pieces) {
      const sorted = own.sort((a, b) => a - b);
      let first = sorted[0];
      sorted.forEach((i, k) => {
        if (k + 1 < sorted.length && sorted[k + 1] - i <= LINKED) return;
        found.push({ lane: this.lanes[number], first, end: i + 1 });
        first = sorted[k + 1];
      });
    }
    return found;
  }

  // Return the drawn record that is nearest to a point, within some metres; null if no ribbon is
  // near.
  drawnAt(x, y, offset, within) {
    const metre = 1 / metresPerWorld(y);
    let best = null;
    let kind = NONE;
    let least = within * metre;
    for (const lane of this.lanes) {
      if (!lane.any) continue;
      const off = lane.both || this.learned ? offset * metre : 0;
      for (let i = 0; i < lane.count; i++) {
        if (lane.kind[i] === NONE) continue;
        const far = distance(x - lane.nx[i] * off, y - lane.ny[i] * off, lane, i);
        if (far < least) {
          least = far;
          kind = lane.kind[i];
          best = [0, -1, 1, -2, 2].map(step => lane.records[i + step]).find(Boolean) ?? best;
        }
      }
    }
    return (
      best && {
        tile: best.tile.block.tile,
        local: best.tile.parts.rows.place[best.k] >> 2,
        sector: best.tile.parts.rows.place[best.k] & 3,
        kind,
      }
    );
  }

  // Return the cell and heading that a click means: those under the pointer if their record is
  // drawn like the ribbon there, else those of the ribbon.
  meantAt(cells, x, y, offset, within) {
    const under = cellAt(x, y);
    const ribbon = this.drawnAt(x, y, offset, within);
    const here = ribbon ? cells.at_place(under.tile, under.local) : [];
    const same = here.some(
      one =>
        one.sector === ribbon.sector &&
        kindOf(one.basis, one.mu, one.lower, one.upper, one.slippery) === ribbon.kind,
    );
    return ribbon && !same ? ribbon : { ...under, sector: ribbon?.sector };
  }

  // Return the name of the nearest road within a distance [m] and the direction of travel there.
  nearest(x, y, within = 40) {
    const column = Math.floor(x * CELLS);
    const row = Math.floor(y * CELLS);
    const most = Math.ceil(within / 8);
    let best = null;
    let least = within / metresPerWorld(y);
    for (let dx = -most; dx <= most; dx++)
      for (let dy = -most; dy <= most; dy++)
        for (const [number, i] of this.byCell.get(keyOf(column + dx, row + dy)) ?? []) {
          const lane = this.lanes[number];
          const far = Math.hypot(lane.x[i] - x, lane.y[i] - y);
          if (lane.name && far < least) {
            least = far;
            best = lane;
          }
        }
    return best?.name ?? "";
  }

  // Return the bounding box of a road, for the search.
  extentOf(name) {
    const own = this.lanes.filter(lane => lane.name === name);
    return {
      west: Math.min(...own.map(l => l.west)),
      east: Math.max(...own.map(l => l.east)),
      north: Math.min(...own.map(l => l.north)),
      south: Math.max(...own.map(l => l.south)),
    };
  }
}

// Return the distance from a point to a piece of a lane.
function distance(x, y, lane, i) {
  const ax = lane.x[i];
  const ay = lane.y[i];
  const dx = lane.x[i + 1] - ax;
  const dy = lane.y[i + 1] - ay;
  const along = ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1);
  const share = Math.min(1, Math.max(0, along));
  return Math.hypot(ax + share * dx - x, ay + share * dy - y);
}

// Fill gaps of one or two pieces between pieces with records: such a gap comes from the cell size,
// not from an unknown road.
function bridge({ kind }) {
  for (let i = 0; i < kind.length; i++) {
    if (kind[i] !== NONE || i === 0 || kind[i - 1] === NONE) continue;
    let end = i;
    while (end < kind.length && kind[end] === NONE) end++;
    if (end < kind.length && end - i <= BRIDGED)
      for (let k = i; k < end; k++) kind[k] = k - i < end - 1 - k ? kind[i - 1] : kind[end];
    i = end;
  }
}

export const isNone = kind => kind === NONE;
