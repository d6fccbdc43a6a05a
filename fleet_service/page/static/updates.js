// Data that the server sends after the start: changed cells, alerts, state of the services, roads
// and areas.
import { begun } from "./alerts.js";
import { kindOf } from "./colours.js";
import { byId } from "./elements.js";
import { CELLS, middleOf } from "./grid.js";
import { followCells } from "./navigation.js";
import { Roads } from "./roads.js";
import { beep } from "./sound.js";
import { ago, say } from "./texts.js";
import { alertWords, bySeverity } from "./words.js";

const ROADS_MS = 1500;
const AGAIN_MS = 15000;
const WORLD = [-180, -85, 180, 85];

/** Updates of the page's state from the server. */
export class Updates {
  /** @param {Page} page the page, whose state is updated and drawn */
  constructor(page) {
    Object.assign(this, { page, missed: false, moreRoads: 0 });
  }

  /**
   * Load what the first picture does not need. The server would otherwise compute it while it
   * should send cells.
   */
  loadBeside() {
    const { page } = this;
    return Promise.all([
      page.timeline.load(),
      this.loadAreas(),
      this.firstRoads ?? this.loadRoads(),
      page.settings.overlay ? this.loadTruth() : null,
    ]);
  }

  /** Load the roads, unless those of the operator's file were loaded. */
  async loadRoads() {
    const { state, map } = this.page;
    if (state.roads && !state.roads.learned) return;
    const answer = await fetch("/roads").catch(() => null);
    if (!answer?.ok) return;
    state.roads = new Roads(await answer.json());
    map.draw();
  }

  /** Load the areas with cells. */
  async loadAreas() {
    const { state, panels } = this.page;
    const answer = await fetch("/areas").catch(() => null);
    if (!answer?.ok) return;
    const before = JSON.stringify(state.areas);
    state.areas = await answer.json();
    if (state.tab === "now" && before !== JSON.stringify(state.areas)) panels.refresh();
  }

  /**
   * Load the cells of the map that is drawn over the live one. Try again later if there is none
   * yet.
   */
  async loadTruth() {
    const { state, map, settings } = this.page;
    const told = await (await fetch("/overlay")).json();
    if (!told) {
      setTimeout(() => this.loadTruth(), AGAIN_MS);
      return;
    }
    state.truth = told.cell.map((cell, k) => {
      const { x, y } = middleOf(Number(cell));
      const mu = Math.round(told.mu[k] * settings.mu_steps);
      return {
        x: x - 0.5 / CELLS,
        y: y - 0.5 / CELLS,
        sector: told.sector[k],
        kind: kindOf(1, mu, mu, mu),
      };
    });
    map.draw();
  }

  /** Load all held cells again, because changes may have been missed. */
  async reload() {
    if (!document.body.dataset.ready) {
      this.missed = true;
      return;
    } // reload after the first picture
    const {
      state: { now },
      map,
      panels,
    } = this.page;
    await now.list();
    followCells(this.page);
    now.restart();
    const { box, level } = map.view;
    await now.fetch([...now.tiles.keys()], level).catch(() => panels.note(say("error.asked")));
    await now.show(box, map.view.level).catch(() => {});
    map.draw();
  }

  /** Apply changed blocks of cells. */
  blocks(found) {
    const { state, map, panels } = this.page;
    const { now } = state;
    const { level } = map.view;
    if (state.show.borrowed) {
      now.fetch(
        found.map(block => block.tile),
        level,
      );
      return;
    }
    const missing = found
      .filter(block => block.level === level && !now.take(block))
      .map(block => block.tile);
    if (missing.length) now.fetch(missing, level).catch(() => {});
    followCells(this.page);
    if (state.refreshChosen() && state.tab === "cell") panels.refresh();
    map.draw();
    if (!this.moreRoads && (state.roads?.learned ?? true))
      this.moreRoads = setTimeout(() => {
        this.moreRoads = 0;
        this.loadRoads();
        this.loadAreas();
      }, ROADS_MS);
    document.body.dataset.pushed = Number(document.body.dataset.pushed || 0) + found.length;
  }

  /** Replace the active alerts, and announce those that are new. */
  alerts(found) {
    const { state, map, panels } = this.page;
    const fresh = state.hasAlerts ? begun(state.alerts, found) : [];
    state.hasAlerts = true;
    state.alerts = bySeverity(found);
    for (const alert of fresh) {
      panels.note(
        say("alerts.new", {
          words: alertWords(alert, state.roadAt(alert.longitude, alert.latitude)),
        }),
      );
      if (state.show.sound) beep();
    }
    byId("tab-alerts").textContent = found.length
      ? `${say("tab.alerts")} (${found.length})`
      : say("tab.alerts");
    document.body.dataset.alerts = found.length;
    if (state.tab === "alerts" || state.tab === "now") panels.refresh();
    map.draw();
  }

  /** Show which regions have no service, by what the server reports every two seconds. */
  beat({ away, served, now }) {
    const { state, map, panels } = this.page;
    const words = byId("away");
    // without any answer of a service, every region counts as not served
    state.away = away.length || served ? away : [{ box: WORLD }];
    words.hidden = !away.length;
    if (away.length)
      words.textContent = say("away", {
        count: away.length,
        ago: ago(now - Math.min(...away.map(one => one.since))),
      });
    panels.tick();
    // the texts of this tab depend on it
    if (state.tab === "now" && state.isServed !== served) panels.refresh();
    state.isServed = served;
    map.draw();
  }
}
