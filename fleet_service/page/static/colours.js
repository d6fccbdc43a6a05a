// Colours of cells, by the numbers of /settings. The rule is that of colours.py, with integer steps
// instead of values. Kinds: 0 to 3 are well known, 4 and 5 roughly known, 6 hardly known, 7 a lower
// bound only (no colour).
import { BORROWED, MEASURED, NO_NUMBER } from "./blocks.js";

export const LITTLE = 6;
export const HOLLOW = 7;
// all kinds, from the most dangerous to the least known
export const DANGER = [0, 1, 4, 2, 5, 3, 6, 7];
const RANK = DANGER.map((_, kind) => DANGER.indexOf(kind));
const INKS = {
  light: {
    bound: "#82858a",
    casing: "#ffffff",
    halo: "#ffffff",
    text: "#1b1d22",
    soft: "#5b6068",
    land: "#f6f5f2",
    park: "#e6ebdd",
    water: "#cfe0ea",
    building: "#e8e4dc",
    edge: "#d9d5cc",
    road: "#ffffff",
    route: "#0a4fb3",
    hatch: "#b9b9b9",
  },
  dark: {
    bound: "#8e9196",
    casing: "#0b0d10",
    halo: "#15181d",
    text: "#e8eaee",
    soft: "#a2a8b3",
    land: "#15181d",
    park: "#1b231e",
    water: "#14283a",
    building: "#1f242b",
    edge: "#0f1216",
    road: "#2c323a",
    route: "#7db4ff",
    hatch: "#4a505a",
  },
};
let rule = null;

export function setColours(settings) {
  const { colours, mu_steps: steps, share_steps: shares } = settings;
  const whole = value => Math.round(value * steps);
  const theme = name => ({
    fills: [...colours[name].four, ...colours[name].two, colours[name].little],
    ground: colours[name].ground,
    alert: colours[name].alert,
    inks: INKS[name],
  });
  rule = {
    edges: colours.edges.map(whole),
    slippery: whole(colours.slippery),
    narrow: whole(colours.narrow),
    known: colours.known * shares,
    middling: whole(colours.middling),
    light: theme("light"),
    dark: theme("dark"),
    theme: rule?.theme ?? "light",
  };
}

export const setTheme = name => {
  rule.theme = name;
};
export const themeName = () => rule.theme;
export const fills = () => rule[rule.theme].fills;
export const alertColour = () => rule[rule.theme].alert;
export const groundColour = () => rule[rule.theme].ground;
export const inks = () => rule[rule.theme].inks;
export const rankOf = kind => RANK[kind];
export const isKnownSlippery = slippery => slippery > rule.known;

// Return the kind of a cell. A place that is more likely slippery than not is never hollow or grey,
// whatever its basis is.
export function kindOf(basis, mu, lower, upper, slippery = 0) {
  const sure = isKnownSlippery(slippery);
  if ((basis !== MEASURED && basis !== BORROWED) || mu === NO_NUMBER)
    return !sure ? HOLLOW : upper < rule.edges[0] ? 0 : upper < rule.slippery ? 1 : 4;
  const width = upper - lower;
  if (upper < rule.slippery || width < rule.narrow) {
    let kind = 0;
    while (kind < rule.edges.length && mu >= rule.edges[kind]) kind++;
    return kind;
  }
  if (sure) return 4;
  if (width < rule.middling) return mu >= rule.slippery ? 5 : 4;
  return LITTLE;
}
