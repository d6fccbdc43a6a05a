// The tiles of one moment: fetched as they come into view, changed as events tell, made ready to be drawn.
import { decode, laidOver, worstOf } from "./blocks.js";
import { kindOf } from "./colours.js";
import { CELL_LEVEL, TILE_LEVEL, TILES, columnOf, rowOf } from "./grid.js";

const AT_ONCE = 200, MOST_TILES = 4000;

// How many places a heading-wise square has beside its record: x and y of its corner in [0, 1], and its side.
function ready(block) {
  const steps = 2 ** (block.level - TILE_LEVEL), side = 1 / (TILES * steps);
  const west = columnOf(block.tile) / TILES, north = rowOf(block.tile) / TILES;
  const lay = rows => {
    const x = new Float64Array(rows.count), y = new Float64Array(rows.count), kind = new Uint8Array(rows.count);
    for (let k = 0; k < rows.count; k++) {
      const local = rows.place[k] >> 2;
      x[k] = west + columnOf(local) * side;
      y[k] = north + rowOf(local) * side;
      kind[k] = kindOf(rows.basis[k], rows.mu[k], rows.lower[k], rows.upper[k]);
    }
    return { rows, x, y, kind, side };
  };
  let squares = null, parts = null;
  return {
    block, west, north,
    get parts() { return parts ??= lay(block); },
    get squares() { return squares ??= block.level === CELL_LEVEL ? lay(worstOf(block)) : this.parts; },
  };
}

export class Cells {
  constructor(at = null) {
    this.at = at;  // seconds since 1970, or null: now
    this.tiles = new Map();
    this.known = new Set();
    this.wanted = new Set();
    this.changed = () => {};
    this.borrowed = false;
    this.generation = 0;
  }

  async list() {
    const answer = await fetch(this.at === null ? "/tiles" : `/tiles?at=${this.at}`);
    if (answer.ok) this.known = new Set(await answer.json());
    return answer.ok;
  }

  // All tiles in view at a level; what is there already stays until its successor has come.
  async show(box, level) {
    const asked = [];
    for (const tile of this.known) {
      const x = columnOf(tile) / TILES, y = rowOf(tile) / TILES;
      if (x + 1 / TILES <= box.west || x >= box.east || y + 1 / TILES <= box.north || y >= box.south) continue;
      if (this.tiles.get(tile)?.block.level !== level && !this.wanted.has(tile)) asked.push(tile);
    }
    await this.fetch(asked, level);
    if (this.tiles.size > MOST_TILES) this.forget(box);
  }

  async fetch(tiles, level) {
    const generation = this.generation, batches = [];
    for (let k = 0; k < tiles.length; k += AT_ONCE) batches.push(tiles.slice(k, k + AT_ONCE));
    tiles.forEach(tile => this.wanted.add(tile));
    try {
      for (const batch of batches) {
        const words = new URLSearchParams({ tiles: batch.join(","), level });
        if (this.at !== null) words.set("at", this.at);
        if (this.borrowed && this.at === null && level === CELL_LEVEL) words.set("borrowed", 1);
        const answer = await fetch(`/blocks?${words}`);
        if (!answer.ok || generation !== this.generation) return;
        decode(await answer.arrayBuffer()).forEach(block => this.take(block));
        this.changed();
      }
    } finally {
      tiles.forEach(tile => this.wanted.delete(tile));
    }
  }

  // True where the block could be used; false where something before it is missing and the tile must be asked for.
  take(block) {
    const held = this.tiles.get(block.tile)?.block;
    this.known.add(block.tile);
    if (block.base === 0) {
      if (!held || held.level !== block.level || held.version <= block.version) this.tiles.set(block.tile, ready(block));
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
      if (west > box.east || west + 1 / TILES < box.west || north > box.south || north + 1 / TILES < box.north) this.tiles.delete(tile);
  }

  empty() {
    this.generation++;
    this.tiles.clear();
    this.wanted.clear();
  }

  // All records of a place of a tile, by heading; [] where nobody was.
  at_place(tile, local) {
    const held = this.tiles.get(tile);
    if (!held) return [];
    const { block } = held, wanted = local >> (2 * (CELL_LEVEL - block.level)), found = [];
    for (let k = 0; k < block.count; k++)
      if (block.place[k] >> 2 === wanted) found.push({ sector: block.place[k] & 3, level: block.level, ...rowOf_(block, k) });
    return found;
  }
}

function rowOf_(block, k) {
  return Object.fromEntries(["last", "mu", "lower", "upper", "slippery", "basis", "vehicles", "unknown"].map(name => [name, block[name][k]]));
}
