// Blocks of cells as the server sends them (records.py): a head of 32 bytes, then columns that are used as they lie.
export const BOUND = 0, MEASURED = 1, BORROWED = 2, GONE = 255, NO_NUMBER = 255;
export const COLUMNS = ["last", "place", "mu", "lower", "upper", "slippery", "basis", "vehicles", "unknown"];
const HEAD = 32, BYTES = 13;

export function decode(buffer) {
  const blocks = [];
  for (let at = 0; at < buffer.byteLength;) {
    const head = new DataView(buffer, at, HEAD), n = head.getUint32(12, true), body = at + HEAD;
    const block = {
      tile: head.getUint32(0, true), version: head.getUint32(4, true), base: head.getUint32(8, true), count: n,
      level: head.getUint8(16), moment: head.getFloat64(24, true),
      last: new Uint32Array(buffer, body, n), place: new Uint16Array(buffer, body + 4 * n, n),
    };
    COLUMNS.slice(2).forEach((name, k) => { block[name] = new Uint8Array(buffer, body + (6 + k) * n, n); });
    blocks.push(block);
    at = body + Math.ceil(BYTES * n / 4) * 4;
  }
  return blocks;
}

export function fromBase64(text) {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let k = 0; k < letters.length; k++) bytes[k] = letters.charCodeAt(k);
  return bytes.buffer;
}

// Two blocks by place, the second laid over the first; what it calls gone is left out.
export function laidOver(before, change) {
  const made = { ...change, base: 0 }, from = [], most = before.count + change.count;
  for (let a = 0, b = 0; a < before.count || b < change.count;) {
    const left = a < before.count ? before.place[a] : Infinity, right = b < change.count ? change.place[b] : Infinity;
    if (right <= left) { if (change.basis[b] !== GONE) from.push(~b); b++; if (left === right) a++; }
    else from.push(a++);
  }
  if (from.length > most) throw new Error("blocks were not sorted");
  made.count = from.length;
  for (const name of COLUMNS) {
    const column = new change[name].constructor(from.length);
    for (let k = 0; k < from.length; k++) column[k] = from[k] < 0 ? change[name][~from[k]] : before[name][from[k]];
    made[name] = column;
  }
  return made;
}

// All headings of a place as one: of each number the worst of what was measured, as records.py does for ancestors.
export function worstOf(block) {
  const rows = [];
  for (let k = 0; k < block.count;) {
    const place = block.place[k] >> 2, row = { place: place << 2, mu: 255, lower: 255, upper: 255, slippery: 0, vehicles: 0, last: 0, basis: BOUND, unknown: 0 };
    let end = k, known = 0, borrowed = 0;
    for (; end < block.count && block.place[end] >> 2 === place; end++) { known += block.basis[end] === MEASURED; borrowed += block.basis[end] === BORROWED; }
    const speaks = known ? MEASURED : borrowed ? BORROWED : BOUND;
    for (let i = k; i < end; i++) {
      row.last = Math.max(row.last, block.last[i]);
      if (block.basis[i] !== speaks) continue;
      for (const name of ["mu", "lower", "upper"]) row[name] = Math.min(row[name], block[name][i]);
      for (const name of ["slippery", "vehicles"]) row[name] = Math.max(row[name], block[name][i]);
    }
    row.basis = speaks;
    row.unknown = block.level === 21 ? Math.ceil(254 * (end - k - known) / (end - k)) : block.unknown[k];
    if (speaks === BOUND) row.mu = NO_NUMBER;
    rows.push(row);
    k = end;
  }
  const made = { ...block, count: rows.length };
  for (const name of COLUMNS) made[name] = block[name].constructor.from(rows, row => row[name]);
  return made;
}
