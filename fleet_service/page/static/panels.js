// The panel beside the map: one of seven, chosen by a tab, and the texts that change with time.
import { alertsPanel } from "./alerts.js";
import { markTab } from "./controls.js";
import { byId } from "./elements.js";
import { healthPanel } from "./health.js";
import { legend } from "./legend.js";
import { overviewPanel } from "./overview.js";
import { placePanel } from "./place.js";
import { routePanel } from "./route.js";
import { sharePanel } from "./share.js";
import { stateCard } from "./states.js";
import { say } from "./texts.js";

const MAKERS = {
  now: overviewPanel,
  legend,
  cell: placePanel,
  alerts: alertsPanel,
  route: routePanel,
  health: healthPanel,
  share: sharePanel,
};
const CLOCK_MS = 500;
const HEALTH_MS = 3000;
const LIST_MS = 15000;
const NOTE_MS = 10000;

/** Names of the tabs, in their order. */
export const TABS = Object.keys(MAKERS);

/** Panels of the page, of which one is open. */
export class Panels {
  /** @param {Page} page the page, whose state the panels describe */
  constructor(page) {
    this.page = page;
  }

  /** Open a panel by the name of its tab. */
  open(name) {
    this.page.state.tab = name;
    markTab(TABS, name);
    this.page.remember();
    this.refresh();
  }

  /** Build the open panel again, and replace the shown one if it differs. */
  async refresh() {
    const { state } = this.page;
    const name = state.tab;
    const made = await MAKERS[name](this.page);
    const held = byId("panel");
    const same =
      held.childNodes.length === made.length &&
      made.every((one, k) => one.isEqualNode(held.childNodes[k]));
    if (name === state.tab && !same) held.replaceChildren(...made);
  }

  /** Show a message for some seconds. */
  note(words) {
    byId("said").textContent = words;
    clearTimeout(this.noting);
    if (words) this.noting = setTimeout(() => this.note(""), NOTE_MS);
  }

  /** Show whether the map is live. Show a card if there is no map. */
  tick() {
    const { live, state } = this.page;
    const words = live.words(state.past?.at ?? null);
    const place = byId("live");
    if (place.textContent !== words) place.textContent = words;
    stateCard(this.page);
    place.dataset.state = words === say("live") ? "live" : "late";
  }

  /** Refresh periodically what no event of the server changes. */
  keepFresh() {
    const { state, timeline, updates } = this.page;
    setInterval(() => this.tick(), CLOCK_MS);
    setInterval(
      () =>
        ["health", "now"].includes(state.tab) &&
        !document.activeElement?.closest("#panel > *") &&
        this.refresh(),
      HEALTH_MS,
    );
    setInterval(() => {
      state.now.list().catch(() => {});
      timeline.load();
      updates.loadAreas();
      updates.loadRoads();
      if (state.tab === "alerts") this.refresh();
    }, LIST_MS);
  }
}
