// What a cell is drawn in, by the numbers of /settings; the same rule as colours.py, in steps instead of numbers.
// Kinds: 0 to 3 well known, 4 and 5 roughly, 6 hardly, 7 a mere bound (no colour).
import { BORROWED, MEASURED, NO_NUMBER } from "./blocks.js";

export const LITTLE = 6, HOLLOW = 7;
let rule = null;

export function setColours(settings) {
  const { colours, mu_steps: steps } = settings, whole = value => Math.round(value * steps);
  rule = {
    edges: colours.edges.map(whole), slippery: whole(colours.slippery), narrow: whole(colours.narrow),
    middling: whole(colours.middling), fills: [...colours.four, ...colours.two, colours.little],
    ground: colours.ground, alert: colours.alert,
  };
}

export const fills = () => rule.fills;
export const alertColour = () => rule.alert;
export const groundColour = () => rule.ground;

export function kindOf(basis, mu, lower, upper) {
  if ((basis !== MEASURED && basis !== BORROWED) || mu === NO_NUMBER) return HOLLOW;
  const width = upper - lower;
  if (upper < rule.slippery || width < rule.narrow) {
    let kind = 0;
    while (kind < rule.edges.length && mu >= rule.edges[kind]) kind++;
    return kind;
  }
  if (width < rule.middling) return mu >= rule.slippery ? 5 : 4;
  return LITTLE;
}
