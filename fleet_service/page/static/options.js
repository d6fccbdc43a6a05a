// Options of the user: what the map shows, and whether alerts have a sound.
import { beep } from "./sound.js";

/** Set an option of `page.state.show`, such as `roads` or `sound`, and apply it. */
export function setOption(page, name, value) {
  const { state, updates, panels, map } = page;
  state.show[name] = value;
  if (name === "borrowed") {
    state.now.borrowed = value;
    updates.reload();
    panels.refresh();
  }
  if (name === "sound" && value) beep();
  page.remember();
  map.draw();
}
