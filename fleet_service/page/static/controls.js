// What is pressed: zoom, tabs, the search, light and dark, the sheet of a phone, the divider.
import { dress, isDark, lift, listenToDivider, preparePaper } from "./appearance.js";
import { byId, make } from "./elements.js";
import { searchBox } from "./search.js";
import { say } from "./texts.js";

// Mark the tab that is open.
export function markTab(tabs, name) {
  for (const one of tabs) Object.assign(byId(`tab-${one}`), { ariaSelected: String(one === name), tabIndex: one === name ? 0 : -1 });
  byId("panel").setAttribute("aria-labelledby", `tab-${name}`);
}

export function addControls(app, tabs) {
  const button = (key, sign, act) => make("button", { type: "button", "aria-label": say(key), title: say(key), onclick: act }, sign);
  byId("controls").append(button("zoom.in", "+", () => app.view.turn(2)), button("zoom.out", "−", () => app.view.turn(.5)), button("zoom.all", say("zoom.all.sign"), () => app.all()));
  byId("map").setAttribute("aria-label", say("map.label"));
  byId("searching").append(...searchBox(app));
  byId("attribution").textContent = app.base?.attribution ?? app.settings.base_map?.attribution ?? "";
  byId("theme").addEventListener("click", () => { app.theme = isDark(app) ? "light" : "dark"; dress(app); app.remember(); });
  byId("sheet").addEventListener("click", lift);
  listenToDivider(share => app.slide(share), () => app.swipe);
  addEventListener("beforeprint", () => preparePaper(app.cells.at ?? app.live.now()));
  byId("tabs").append(...tabs.map(name => make("button", { type: "button", role: "tab", id: `tab-${name}`, "aria-controls": "panel", "aria-selected": "false", onclick: () => app.open(name) }, say(`tab.${name}`))));
  byId("panel").setAttribute("role", "tabpanel");
  markTab(tabs, app.tab);
  byId("tabs").addEventListener("keydown", e => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
    if (!step) return;
    app.open(tabs[(tabs.indexOf(app.tab) + step + tabs.length) % tabs.length]);
    byId(`tab-${app.tab}`).focus();
  });
}
