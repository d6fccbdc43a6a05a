// Text about the ribbons in view: slippery stretches without an alert, and the unknown share of the
// roads.
import { LITTLE, rankOf } from "./colours.js";
import { HEADINGS, metresPerWorld } from "./grid.js";
import { WAYS, isNone } from "./roads.js";

// GAP and LEAST_PIECES count pieces of 8 m. ASIDE_M is the distance between the middle of a lane
// and that of the road.
const SLIPPERY = [0, 1, 4];
const GAP = 2;
const LEAST_PIECES = 2;
const ASIDE_M = 1.9;

// Return the heading of a lane at a piece: the nearest of the four.
function headingAt(lane, i) {
  const cosines = WAYS.map(([wx, wy]) => lane.ny[i] * wx - lane.nx[i] * wy);
  return HEADINGS[cosines.indexOf(Math.max(...cosines))];
}

const inBox = (lane, i, box) =>
  lane.x[i] >= box.west &&
  lane.x[i] <= box.east &&
  lane.y[i] >= box.north &&
  lane.y[i] <= box.south;

// Return the slippery stretches of lanes in view, the most dangerous first. Stretches under an
// alert are left out.
export function slipperyStretches(roads, box, alerts) {
  const alerted = new Map();
  const found = [];
  for (const { lane, first, end } of alerts.flatMap(alert => roads.under(alert)))
    for (let i = first - GAP; i < end + GAP; i++)
      alerted.set(lane, (alerted.get(lane) ?? new Set()).add(i));
  for (const lane of roads.lanes) {
    if (!lane.any) continue;
    const own = [...lane.kind.keys()].filter(
      i => SLIPPERY.includes(lane.kind[i]) && !alerted.get(lane)?.has(i) && inBox(lane, i, box),
    );
    for (let k = 0, from = 0; k < own.length; k++) {
      if (k + 1 < own.length && own[k + 1] - own[k] <= GAP + 1) continue;
      const pieces = own.slice(from, k + 1);
      from = k + 1;
      if (pieces.length >= LEAST_PIECES) found.push(stretchOf(lane, pieces));
    }
  }
  return found.sort((a, b) => rankOf(a.kind) - rankOf(b.kind) || b.length_m - a.length_m);
}

function stretchOf(lane, pieces) {
  const own = pieces.filter(i => lane.records[i]);
  const worst = (own.length ? own : pieces).reduce((a, b) =>
    rankOf(lane.kind[b]) < rankOf(lane.kind[a]) ? b : a,
  );
  const metre = 1 / metresPerWorld(lane.y[worst]);
  const aside = ASIDE_M * metre;
  const most = name =>
    Math.max(0, ...own.map(i => lane.records[i].tile.parts.rows[name][lane.records[i].k]));
  return {
    name: lane.name,
    heading: headingAt(lane, worst),
    kind: lane.kind[worst],
    length_m: (pieces.length * lane.length) / lane.count / metre,
    slippery: most("slippery"),
    vehicles: most("vehicles"),
    // Position of the worst piece.
    x: (lane.x[worst] + lane.x[worst + 1]) / 2 + lane.nx[worst] * aside,
    y: (lane.y[worst] + lane.y[worst + 1]) / 2 + lane.ny[worst] * aside,
  };
}

// Return the shares of the lanes in view: slippery, not slippery, visited but unknown, and never
// visited. Return null if no lane is in view.
export function sharesOf(roads, box) {
  // Lines that were learned from vehicles do not show roads that no vehicle visited.
  const metres = { slippery: 0, grip: 0, unknown: 0, never: 0 };
  for (const lane of roads.lanes) {
    const piece = (lane.length / lane.count) * metresPerWorld(lane.y[0]);
    for (let i = 0; i < lane.count; i++) {
      if (!inBox(lane, i, box)) continue;
      const kind = lane.kind[i];
      if (roads.learned && isNone(kind)) continue;
      metres[
        isNone(kind)
          ? "never"
          : kind >= LITTLE
            ? "unknown"
            : SLIPPERY.includes(kind)
              ? "slippery"
              : "grip"
      ] += piece;
    }
  }
  const whole = Object.values(metres).reduce((a, b) => a + b);
  return whole ? { whole, ...metres } : null;
}
