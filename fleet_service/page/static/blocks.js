// Blocks of cells as the server sends them (records.py): a header of 32 bytes, then columns that
// are used without copying.
export const BOUND = 0;
export const MEASURED = 1;
export const BORROWED = 2;
export const GONE = 255;
export const NO_NUMBER = 255;
export const COLUMNS = [
  "last",
  "place",
  "mu",
  "lower",
  "upper",
  "slippery",
  "basis",
  "vehicles",
  "unknown",
];
const HEAD = 32;
const BYTES = 13;

export function decode(buffer) {
  const blocks = [];
  for (let at = 0; at < buffer.byteLength;) {
    const head = new DataView(buffer, at, HEAD);
    const n = head.getUint32(12, true);
    const body = at + HEAD;
    const block = {
      tile: head.getUint32(0, true),
      version: head.getUint32(4, true),
      base: head.getUint32(8, true),
      count: n,
      level: head.getUint8(16),
      moment: head.getFloat64(24, true),
      last: new Uint32Array(buffer, body, n),
      place: new Uint16Array(buffer, body + 4 * n, n),
    };
    COLUMNS.slice(2).forEach((name, k) => {
      block[name] = new Uint8Array(buffer, body + (6 + k) * n, n);
    });
    blocks.push(block);
    at = body + Math.ceil((BYTES * n) / 4) * 4;
  }
  return blocks;
}

export function fromBase64(text) {
  const letters = atob(text);
  const bytes = new Uint8Array(letters.length);
  for (let k = 0; k < letters.length; k++) bytes[k] = letters.charCodeAt(k);
  return bytes.buffer;
}

// Merge two blocks by place. The second one overrides the first; rows that it marks as GONE are
// left out.
export function laidOver(before, change) {
  const made = { ...change, base: 0 };
  const from = [];
  const most = before.count + change.count;
  for (let a = 0, b = 0; a < before.count || b < change.count;) {
    const left = a < before.count ? before.place[a] : Infinity;
    const right = b < change.count ? change.place[b] : Infinity;
    if (right <= left) {
      if (change.basis[b] !== GONE) from.push(~b);
      b++;
      if (left === right) a++;
    } else from.push(a++);
  }
  if (from.length > most) throw new Error("blocks were not sorted");
  made.count = from.length;
  for (const name of COLUMNS) {
    const column = new change[name].constructor(from.length);
    for (let k = 0; k < from.length; k++)
      column[k] = from[k] < 0 ? change[name][~from[k]] : before[name][from[k]];
    made[name] = column;
  }
  return made;
}

// Merge all headings of a place into one row with the worst measured value of each column, as
// records.py does for ancestors.
export function worstOf(block) {
  const made = { ...block, count: 0 };
  const n = block.count;
  const { place, basis } = block;
  for (const name of COLUMNS) made[name] = new block[name].constructor(n);
  for (let k = 0, end; k < n; k = end) {
    const at = made.count++;
    const where = place[k] >> 2;
    let known = 0;
    let borrowed = 0;
    for (end = k; end < n && place[end] >> 2 === where; end++) {
      known += basis[end] === MEASURED;
      borrowed += basis[end] === BORROWED;
    }
    const speaks = known ? MEASURED : borrowed ? BORROWED : BOUND;
    let mu = NO_NUMBER;
    let lower = NO_NUMBER;
    let upper = NO_NUMBER;
    let slippery = 0;
    let vehicles = 0;
    let last = 0;
    for (let i = k; i < end; i++) {
      last = Math.max(last, block.last[i]);
      if (basis[i] !== speaks) continue;
      mu = Math.min(mu, block.mu[i]);
      lower = Math.min(lower, block.lower[i]);
      upper = Math.min(upper, block.upper[i]);
      slippery = Math.max(slippery, block.slippery[i]);
      vehicles = Math.max(vehicles, block.vehicles[i]);
    }
    made.place[at] = where << 2;
    made.last[at] = last;
    made.mu[at] = speaks === BOUND ? NO_NUMBER : mu;
    made.lower[at] = lower;
    made.upper[at] = upper;
    made.slippery[at] = slippery;
    made.basis[at] = speaks;
    made.vehicles[at] = vehicles;
    made.unknown[at] =
      block.level === 21 ? Math.ceil((254 * (end - k - known)) / (end - k)) : block.unknown[k];
  }
  for (const name of COLUMNS) made[name] = made[name].subarray(0, made.count);
  return made;
}
