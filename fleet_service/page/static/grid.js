// Coordinates: the Web Mercator square as [0, 1] × [0, 1], cells at zoom 21, tiles at zoom 14, as
// in schemas/grid.py.
export const CELL_LEVEL = 21;
export const TILE_LEVEL = 14;
export const SECTORS = 4;
export const CELLS = 2 ** CELL_LEVEL;
export const TILES = 2 ** TILE_LEVEL;
// names of the sectors, as in files and alerts
export const HEADINGS = ["east", "north", "west", "south"];
const EARTH_M = 2 * Math.PI * 6378137;

export const worldX = longitude => (longitude + 180) / 360;
export const worldY = latitude =>
  (1 - Math.asinh(Math.tan((latitude * Math.PI) / 180)) / Math.PI) / 2;
export const longitudeOf = x => x * 360 - 180;
export const latitudeOf = y => (Math.atan(Math.sinh(Math.PI * (1 - 2 * y))) * 180) / Math.PI;
export const degreesOf = (x, y) => [longitudeOf(x), latitudeOf(y)];
export const metresPerWorld = y => EARTH_M * Math.cos((latitudeOf(y) * Math.PI) / 180);

// Collect every second bit of a number below 2^32.
export function gather(v) {
  v &= 0x55555555;
  v = (v | (v >>> 1)) & 0x33333333;
  v = (v | (v >>> 2)) & 0x0f0f0f0f;
  v = (v | (v >>> 4)) & 0x00ff00ff;
  return (v | (v >>> 8)) & 0x0000ffff;
}

function spread(v) {
  v = (v | (v << 8)) & 0x00ff00ff;
  v = (v | (v << 4)) & 0x0f0f0f0f;
  v = (v | (v << 2)) & 0x33333333;
  return (v | (v << 1)) & 0x55555555;
}

export const tileOf = (x, y) => (spread(x) | (spread(y) << 1)) >>> 0;
export const columnOf = quadint => gather(quadint);
export const rowOf = quadint => gather(quadint >>> 1);

// A cell number has 42 bits: the number of its tile, and 14 bits within the tile.
export const cellOf = (tile, local) => tile * 16384 + local;
export const tileOfCell = cell => Math.floor(cell / 16384);
export const localOfCell = cell => cell % 16384;

export function cellAt(x, y) {
  const column = Math.floor(x * CELLS);
  const row = Math.floor(y * CELLS);
  const tile = tileOf(column >> 7, row >> 7);
  const local = tileOf(column & 127, row & 127);
  return { tile, local };
}

export function middleOf(cell) {
  const tile = tileOfCell(cell);
  const local = localOfCell(cell);
  return {
    x: (columnOf(tile) * 128 + columnOf(local) + 0.5) / CELLS,
    y: (rowOf(tile) * 128 + rowOf(local) + 0.5) / CELLS,
  };
}
