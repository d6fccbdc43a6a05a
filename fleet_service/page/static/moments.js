// Past moments of the map: a single one, or two side by side.
import { Cells } from "./cells.js";
import { byId } from "./elements.js";

/**
 * Show the map of a past moment.
 * @param {Page} page the page
 * @param {?number} at moment [s since 1970]; null for now
 */
export async function goToMoment(page, at) {
  const { state, map } = page;
  const before = state.past;
  const past = at === null ? null : new Cells(at);
  if (past) {
    past.changed = () => map.draw();
    await past.list();
    await past.show(map.view.box, map.view.level);
  }
  if (state.past !== before) return; // the user chose another moment meanwhile
  state.past = past;
  if (state.chosen) page.choose(state.chosen.tile, state.chosen.local, state.chosen.sector);
  page.panels.tick();
  page.remember();
  map.drawNow();
  document.body.dataset.at = at ?? "now";
}

/**
 * Begin or end a comparison. The moment that is shown now stays on the right, and the slider
 * changes the left side.
 * @param {Page} page the page
 * @param {boolean} on true to begin
 * @param {Cells} pinned cells for the right side
 */
export async function compareMoments(page, on, pinned = page.state.cells) {
  const { state, map } = page;
  Object.assign(state, { comparing: on, pinned: on ? pinned : null });
  pinned.changed = () => map.draw();
  for (const id of ["moment-left", "moment-right"]) byId(id).hidden = !on;
  if (on && pinned.at !== null) await pinned.list();
  map.resize();
  page.timeline.say();
  map.look();
}
