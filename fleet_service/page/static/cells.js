// Map tiles of one moment. They are fetched when they come into view, changed by events, and
// prepared for drawing.
import { decode, laidOver, worstOf } from "./blocks.js";
import { kindOf } from "./colours.js";
import { CELL_LEVEL, TILE_LEVEL, TILES, columnOf, rowOf } from "./grid.js";

const AT_ONCE = 200;
const MOST_TILES = 4000;

// Return what drawing needs in addition to a block's records: column and row within the tile, the
// corner as x and y in [0, 1], and the side. Squares have all headings merged; parts have one row
// per heading.
function ready(block) {
  const steps = 2 ** (block.level - TILE_LEVEL);
  const side = 1 / (TILES * steps);
  const west = columnOf(block.tile) / TILES;
  const north = rowOf(block.tile) / TILES;
  const lay = rows => {
    const n = rows.count;
    const x = new Float64Array(n);
    const y = new Float64Array(n);
    const column = new Uint8Array(n);
    const row = new Uint8Array(n);
    const kind = new Uint8Array(n);
    for (let k = 0; k < n; k++) {
      const local = rows.place[k] >> 2;
      column[k] = columnOf(local);
      row[k] = rowOf(local);
      x[k] = west + column[k] * side;
      y[k] = north + row[k] * side;
      kind[k] = kindOf(rows.basis[k], rows.mu[k], rows.lower[k], rows.upper[k], rows.slippery[k]);
    }
    return { rows, x, y, column, row, kind, side, west, north, steps };
  };
  let squares = null;
  let parts = null;
  return {
    block,
    west,
    north,
    get parts() {
      return (parts ??= lay(block));
    },
    get squares() {
      return (squares ??= block.level === CELL_LEVEL ? lay(worstOf(block)) : this.parts);
    },
  };
}

export class Cells {
  constructor(at = null) {
    this.at = at; // [s since 1970]; null means now
    this.tiles = new Map();
    this.known = new Set();
    this.asking = new Map(); // level and promise of the last request, by tile
    this.changed = () => {};
    this.borrowed = false;
  }

  async list() {
    const answer = await fetch(this.at === null ? "/tiles" : `/tiles?at=${this.at}`);
    if (answer.ok) this.known = new Set(await answer.json());
    return answer.ok;
  }

  // Load all tiles in view at a level. A tile that is already shown stays until its successor has
  // arrived.
  async show(box, level) {
    const asked = [];
    const awaited = [];
    for (const tile of this.known) {
      const x = columnOf(tile) / TILES;
      const y = rowOf(tile) / TILES;
      if (
        x + 1 / TILES <= box.west ||
        x >= box.east ||
        y + 1 / TILES <= box.north ||
        y >= box.south
      )
        continue;
      const asking = this.asking.get(tile);
      if (asking?.level === level) awaited.push(asking.answered);
      else if (asking || this.tiles.get(tile)?.block.level !== level) asked.push(tile);
    }
    await Promise.all([this.fetch(asked, level), ...awaited]);
    if (this.tiles.size > MOST_TILES) this.forget(box);
  }

  // Request tiles, also those that are already loaded.
  fetch(tiles, level) {
    const asking = { level };
    tiles.forEach(tile => this.asking.set(tile, asking));
    asking.answered = this.request(tiles, asking).finally(() =>
      tiles.forEach(tile => {
        if (this.asking.get(tile) === asking) this.asking.delete(tile);
      }),
    );
    return asking.answered;
  }

  // Apply the answers, except those of tiles that were requested again since.
  async request(tiles, asking) {
    const { level } = asking;
    const isLast = tile => this.asking.get(tile) === asking;
    for (let k = 0; k < tiles.length; k += AT_ONCE) {
      const wanted = tiles.slice(k, k + AT_ONCE).filter(isLast);
      if (!wanted.length) continue;
      const words = new URLSearchParams({ tiles: wanted.join(","), level });
      if (this.at !== null) words.set("at", this.at);
      if (this.borrowed && this.at === null && level === CELL_LEVEL) words.set("borrowed", 1);
      const answer = await fetch(`/blocks?${words}`);
      if (!answer.ok) return;
      for (const block of decode(await answer.arrayBuffer()))
        if (isLast(block.tile)) this.take(block);
      this.changed();
    }
  }

  // Apply a block. Return false if an earlier block is missing, so that the tile must be requested.
  take(block) {
    const held = this.tiles.get(block.tile)?.block;
    this.known.add(block.tile);
    if (block.base === 0) {
      if (!held || held.level !== block.level || held.version <= block.version)
        this.tiles.set(block.tile, ready(block));
      return true;
    }
    if (!held || held.level !== block.level || held.version < block.base) return false;
    if (held.version >= block.version) return true;
    if (held.version !== block.base) return false;
    this.tiles.set(block.tile, ready(laidOver(held, block)));
    return true;
  }

  forget(box) {
    for (const [tile, { west, north }] of this.tiles)
      if (
        west > box.east ||
        west + 1 / TILES < box.west ||
        north > box.south ||
        north + 1 / TILES < box.north
      )
        this.tiles.delete(tile);
  }

  // Bounding box of the loaded cells and of the known tiles that are not loaded; null without any.
  get extent() {
    const found = { west: Infinity, north: Infinity, east: -Infinity, south: -Infinity };
    const grow = (west, north, side) => {
      found.west = Math.min(found.west, west);
      found.north = Math.min(found.north, north);
      found.east = Math.max(found.east, west + side);
      found.south = Math.max(found.south, north + side);
    };
    for (const tile of this.known) {
      const held = this.tiles.get(tile);
      if (!held) {
        grow(columnOf(tile) / TILES, rowOf(tile) / TILES, 1 / TILES);
        continue;
      }
      const { x, y, side } = held.parts;
      for (let k = 0; k < x.length; k++) grow(x[k], y[k], side);
    }
    return Number.isFinite(found.west) ? found : null;
  }

  // From now on, ignore answers to earlier requests.
  restart() {
    this.asking.clear();
  }

  // Return all records of a place in a tile, one per heading; [] if no vehicle was there.
  at_place(tile, local) {
    const held = this.tiles.get(tile);
    if (!held) return [];
    const { block } = held;
    const wanted = local >> (2 * (CELL_LEVEL - block.level));
    const found = [];
    for (let k = 0; k < block.count; k++)
      if (block.place[k] >> 2 === wanted)
        found.push({ sector: block.place[k] & 3, level: block.level, ...rowOf_(block, k) });
    return found;
  }
}

function rowOf_(block, k) {
  return Object.fromEntries(
    ["last", "mu", "lower", "upper", "slippery", "basis", "vehicles", "unknown"].map(name => [
      name,
      block[name][k],
    ]),
  );
}
