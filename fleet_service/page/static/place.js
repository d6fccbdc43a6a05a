// The panel of one place: for each heading the friction, its certainty and age, and the safe speed.
import { BORROWED, MEASURED, NO_NUMBER } from "./blocks.js";
import { density, history } from "./charts.js";
import { make } from "./elements.js";
import { HEADINGS, cellOf, degreesOf } from "./grid.js";
import { kindOf, rankOf } from "./colours.js";
import { ago, clock, say, zone } from "./texts.js";
import { certainty, coordinates } from "./words.js";

const BASES = { [MEASURED]: "measured", [BORROWED]: "borrowed" };

export function safeSpeed(lower, sight, reaction) {
  const grip = 9.81 * lower;
  return grip > 0 ? grip * (Math.sqrt(reaction ** 2 + (2 * sight) / grip) - reaction) : 0;
}

// Return a record as numbers; `mu` is null if nothing was measured.
export function numbers(record, settings) {
  const { mu_steps: steps, share_steps: shares } = settings;
  // Known ice is never a mere bound.
  const sure = record.slippery > shares / 2;
  const basis = BASES[record.basis] ?? (sure ? "measured" : "bound");
  const mu =
    basis === "bound"
      ? null
      : record.mu === NO_NUMBER
        ? (record.lower + record.upper) / 2 / steps
        : record.mu / steps;
  return {
    ...record,
    basis,
    mu,
    lower: record.lower / steps,
    upper: record.upper / steps,
    slippery: Math.min(1, record.slippery / shares),
    unknown: record.unknown / shares,
  };
}

const two = value => value.toFixed(2);
// Round so that neither the friction nor the certainty is overstated.
const down = value => (Math.floor(value * 100 + 1e-6) / 100).toFixed(2);
const percent = value =>
  value > 0.995
    ? say("percent.over", { n: 99 })
    : value < 0.005
      ? say("percent.under", { n: 1 })
      : String(Math.ceil(value * 100 - 1e-6));

/** Return the elements of the panel about the chosen place. */
export function placePanel(page) {
  const { chosen } = page.state;
  if (!chosen) return [make("p", {}, say("cell.none"))];
  const head = placeHead(page, chosen);
  if (!chosen.records.length) return [...head, make("p", { class: "nobody" }, say("cell.nobody"))];
  const kind = record =>
    kindOf(record.basis, record.mu, record.lower, record.upper, record.slippery);
  const ordered = [...chosen.records].sort(
    (a, b) =>
      (b.sector === chosen.sector) - (a.sector === chosen.sector) ||
      rankOf(kind(a)) - rankOf(kind(b)),
  );
  return [
    ...head,
    ...ordered.map(record => one(page, chosen, numbers(record, page.settings), kind(record))),
  ];
}

// Build the head of the panel: road, coordinates to copy, and number of the cell.
function placeHead(page, chosen) {
  const [longitude, latitude] = degreesOf(chosen.middleX, chosen.middleY);
  const where = coordinates(longitude, latitude);
  const road = page.state.roadAt(longitude, latitude);
  const copy = make(
    "button",
    {
      type: "button",
      onclick: async e => {
        await navigator.clipboard?.writeText(`${latitude.toFixed(6)}, ${longitude.toFixed(6)}`);
        e.target.textContent = say("cell.copied");
      },
    },
    say("cell.copy"),
  );
  return [
    make("h2", {}, road || say("tab.cell")),
    make("p", { class: "line place" }, make("span", { "data-value": "coordinates" }, where), copy),
  ];
}

function one(page, chosen, cell, kind) {
  const now = page.state.cells.at ?? page.live.now();
  const whole = cell.level === 21;
  const limit = page.settings.colours.slippery;
  const list = make("dl", {});
  const line = (name, value, id) =>
    list.append(make("dt", {}, name), make("dd", { "data-value": id }, value));
  line(
    say("cell.grip"),
    cell.mu === null
      ? say("cell.grip.bound", { lower: down(cell.lower) })
      : say("cell.grip.value", {
          mu: two(cell.mu),
          lower: down(cell.lower),
          upper: two(cell.upper),
        }),
    "grip",
  );
  if (cell.mu !== null)
    line(
      say("cell.slippery"),
      say("cell.slippery.value", { percent: percent(cell.slippery), limit }),
      "slippery",
    );
  line(say("cell.basis"), say(`basis.${cell.basis}`), "basis");
  const speeds =
    cell.basis === "measured"
      ? page.settings.sights_m.map(sight =>
          say("cell.speed.value", {
            speed: Math.floor(3.6 * safeSpeed(cell.lower, sight, page.settings.reaction_s)),
            sight,
          }),
        )
      : [say("cell.speed.unknown")];
  line(say("cell.speed"), speeds.join("; "), "speed");
  line(say("cell.vehicles"), cell.vehicles === 255 ? "255+" : String(cell.vehicles), "vehicles");
  line(
    say("cell.age"),
    say("cell.age.value", {
      ago: ago(now - cell.last),
      time: `${clock(cell.last)} ${zone(cell.last)}`,
    }),
    "age",
  );
  for (const alert of alertsAt(page, chosen, whole ? HEADINGS[cell.sector] : null))
    line(
      say("cell.alert"),
      say("cell.alert.value", { count: alert.vehicles, percent: certainty(alert.p_slippery) }),
      "alert",
    );
  const where = whole
    ? say("cell.heading", { heading: say(`heading.${cell.sector}`) })
    : say("cell.square");
  const past = make("div", { class: "history" });
  const section = make(
    "section",
    { class: "heading", "data-sector": cell.sector },
    make(
      "div",
      { class: "headline" },
      make("span", { class: `swatch ${kind === 7 ? "hollow" : `k${kind}`}` }),
      make("h3", {}, `${say(`cell.headline.${kind}`)}, ${where}`),
    ),
    list,
    cell.basis === "measured"
      ? make("p", { class: "note" }, say("cell.speed.note", { reaction: page.settings.reaction_s }))
      : null,
    make(
      "figure",
      {},
      density(cell, limit),
      make("figcaption", {}, say(cell.mu === null ? "cell.density.bound" : "cell.density")),
    ),
    past,
  );
  if (whole) fillIn(page, chosen, cell, list, past);
  return section;
}

// Return the alerts of a place, and of a heading if one is given: an alert holds for its own
// headings only.
const alertsAt = (page, { x, y }, heading) =>
  page.state.cells.at !== null
    ? []
    : page.state.alerts.filter(alert => {
        if (heading !== null && !alert.headings.includes(heading)) return false;
        const [west, south, east, north] = alert.bbox;
        const at = degreesOf(x, y);
        return west <= at[0] && at[0] <= east && south <= at[1] && at[1] <= north;
      });

// Fill in what only the service and the archive know: exact counts and the history.
async function fillIn(page, chosen, cell, list, past) {
  const name = `${cellOf(chosen.tile, chosen.local)}/${cell.sector}`;
  if (page.state.cells.at === null) {
    const answer = await fetch(`/cell/${name}`);
    const told = answer.ok ? await answer.json() : null;
    if (told)
      list.append(
        make("dt", {}, say("cell.observations")),
        make("dd", { "data-value": "observations" }, String(told.observations)),
      );
  }
  const answer = await fetch(`/history/${name}`);
  const rows = answer.ok ? await answer.json() : [];
  past.append(make("h3", {}, say("cell.history")));
  past.append(
    ...(rows.length
      ? [
          history(rows, page.settings.colours.slippery),
          make("p", { class: "note" }, say("cell.history.label")),
        ]
      : [make("p", {}, say("cell.history.none"))]),
  );
}
