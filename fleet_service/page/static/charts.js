// Drawings of one place and of a route, as SVG.
import { draw } from "./elements.js";
import { clock, say } from "./texts.js";

const LEAST = 0.05;
const MOST = 1.2; // limits of the friction grid

// Return a density with the quantiles that the service gives: 5, 50 and 95 %. The normal score of
// the friction is a monotone cubic through them (Fritsch and Carlson, SIAM J. Numer. Anal. 17,
// 1980) and linear beyond. The density is smooth, and its quantiles are exact.
export function densityOf({ lower, mu, upper }) {
  const left = Math.max(mu - lower, 0.005);
  const right = Math.max(upper - mu, 0.005);
  const score = 1.6449;
  const chords = [score / left, score / right];
  const middle = 2 / (1 / chords[0] + 1 / chords[1]);
  const piece = (t, h, m0, m1, d) => [
    (t ** 3 - 2 * t ** 2 + t) * h * m0 +
      (t ** 3 - t ** 2) * h * m1 +
      (3 * t ** 2 - 2 * t ** 3) * h * d,
    (1 - t) * (1 - 3 * t) * m0 + t * (3 * t - 2) * m1 + 6 * t * (1 - t) * d,
  ];
  const points = [];
  for (let k = 0; k <= 230; k++) {
    const x = LEAST + (k / 230) * (MOST - LEAST);
    let z;
    let slope;
    if (x < mu - left) [z, slope] = [-score + (x - mu + left) * chords[0], chords[0]];
    else if (x > mu + right) [z, slope] = [score + (x - mu - right) * chords[1], chords[1]];
    else if (x < mu) {
      [z, slope] = piece((x - mu + left) / left, left, chords[0], middle, chords[0]);
      z -= score;
    } else [z, slope] = piece((x - mu) / right, right, middle, chords[1], chords[1]);
    points.push([x, Math.exp((-z * z) / 2) * Math.max(slope, 0)]);
  }
  return points;
}

export function density(cell, limit) {
  const W = 320;
  const H = 130;
  const x = mu => 12 + ((mu - LEAST) / (MOST - LEAST)) * (W - 24);
  const floor = H - 22;
  const picture = draw("svg", {
    viewBox: `0 0 ${W} ${H}`,
    role: "img",
    class: "chart",
    "aria-label": say(cell.mu === null ? "cell.density.bound" : "cell.density"),
  });
  picture.append(
    draw("rect", {
      x: x(LEAST),
      y: 8,
      width: x(limit) - x(LEAST),
      height: floor - 8,
      class: "slippery",
    }),
  );
  picture.append(
    draw("rect", {
      x: x(cell.lower),
      y: floor - 6,
      width: x(cell.upper) - x(cell.lower),
      height: 6,
      class: "interval",
    }),
  );
  if (cell.mu !== null) {
    const points = densityOf(cell);
    const top = Math.max(...points.map(([, v]) => v));
    const path = points.map(
      ([mu, v]) => `${x(mu).toFixed(1)},${(floor - 8 - (v / top) * (floor - 20)).toFixed(1)}`,
    );
    picture.append(
      draw("polygon", {
        points: `${x(LEAST)},${floor - 8} ${path.join(" ")} ${x(MOST)},${floor - 8}`,
        class: "density",
      }),
    );
    picture.append(
      draw("line", { x1: x(cell.mu), x2: x(cell.mu), y1: 8, y2: floor, class: "middle" }),
    );
  }
  for (const mu of [0.2, 0.4, 0.6, 0.8, 1])
    picture.append(draw("text", { x: x(mu), y: H - 6, class: "tick" }, String(mu)));
  return picture;
}

export function history(rows, shown) {
  const W = 320;
  const H = 140;
  const first = rows[0].moment;
  const last = Math.max(rows.at(-1).moment, first + 1);
  const x = t => 26 + ((t - first) / (last - first)) * (W - 40);
  const y = mu => H - 24 - ((mu - LEAST) / (MOST - LEAST)) * (H - 34);
  const picture = draw("svg", {
    viewBox: `0 0 ${W} ${H}`,
    role: "img",
    class: "chart",
    "aria-label": say("cell.history.label"),
  });
  picture.append(
    draw("rect", {
      x: 26,
      y: y(shown),
      width: W - 40,
      height: y(LEAST) - y(shown),
      class: "slippery",
    }),
  );
  for (const mu of [0.2, 0.4, 0.6, 0.8, 1])
    picture.append(draw("text", { x: 22, y: y(mu) + 3, class: "tick end" }, String(mu)));
  for (const row of rows) {
    const at = x(row.moment);
    picture.append(
      draw("line", {
        x1: at,
        x2: at,
        y1: y(row.mu_lower),
        y2: y(row.mu_upper),
        class: row.mu === null ? "bound" : "span",
      }),
    );
    if (row.mu !== null)
      picture.append(draw("circle", { cx: at, cy: y(row.mu), r: 2.5, class: "middle" }));
  }
  picture.append(
    draw("text", { x: 26, y: H - 6, class: "tick start" }, clock(first).slice(5, 16)),
    draw("text", { x: W - 14, y: H - 6, class: "tick end" }, clock(last).slice(5, 16)),
  );
  return picture;
}

export function profile(found, limit, pointed) {
  const W = 400;
  const H = 150;
  const x = m => 30 + (m / found.length_m) * (W - 40);
  const y = mu => H - 26 - ((mu - LEAST) / (MOST - LEAST)) * (H - 36);
  const picture = draw("svg", {
    viewBox: `0 0 ${W} ${H}`,
    role: "img",
    class: "chart wide",
    "aria-label": say("route.label"),
  });
  picture.append(
    draw("rect", {
      x: 30,
      y: y(limit),
      width: W - 40,
      height: y(LEAST) - y(limit),
      class: "slippery",
    }),
  );
  for (const one of found.stretches) {
    const left = x(one.from_m);
    const width = Math.max(x(one.to_m) - left, 0.5);
    const measured = one.basis === "measured";
    const box = measured
      ? { y: y(one.mu_upper), height: y(one.mu_lower) - y(one.mu_upper), class: "interval" }
      : {
          y: y(MOST),
          height: y(LEAST) - y(MOST),
          class: one.basis === "bound" ? "passed" : "unknown",
        };
    picture.append(draw("rect", { x: left, width, ...box, onclick: () => pointed(one) }));
    if (measured)
      picture.append(
        draw("line", { x1: left, x2: left + width, y1: y(one.mu), y2: y(one.mu), class: "middle" }),
      );
  }
  for (const mu of [0.2, 0.4, 0.6, 0.8, 1])
    picture.append(draw("text", { x: 26, y: y(mu) + 3, class: "tick end" }, String(mu)));
  picture.append(
    draw("text", { x: 30, y: H - 8, class: "tick start" }, say("scale.kilometres", { n: 0 })),
    draw(
      "text",
      { x: W - 10, y: H - 8, class: "tick end" },
      say("scale.kilometres", { n: (found.length_m / 1000).toFixed(2) }),
    ),
  );
  return picture;
}
