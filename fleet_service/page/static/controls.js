// Controls: zoom, tabs, search, theme, sheet of a phone, divider.
import { dress, isDark, lift, listenToDivider, preparePaper } from "./appearance.js";
import { byId, make } from "./elements.js";
import { showAll } from "./navigation.js";
import { searchBox } from "./search.js";
import { say } from "./texts.js";

// Mark the open tab.
export function markTab(tabs, name) {
  for (const one of tabs)
    Object.assign(byId(`tab-${one}`), {
      ariaSelected: String(one === name),
      tabIndex: one === name ? 0 : -1,
    });
  byId("panel").setAttribute("aria-labelledby", `tab-${name}`);
}

export function addControls(page, tabs) {
  const button = (key, sign, act) =>
    make("button", { type: "button", "aria-label": say(key), title: say(key), onclick: act }, sign);
  byId("controls").append(
    button("zoom.in", "+", () => page.map.view.turn(2)),
    button("zoom.out", "−", () => page.map.view.turn(0.5)),
    button("zoom.all", say("zoom.all.sign"), () => showAll(page)),
  );
  byId("map").setAttribute("aria-label", say("map.label"));
  byId("searching").append(...searchBox(page));
  byId("attribution").textContent =
    page.map.base?.attribution ?? page.settings.base_map?.attribution ?? "";
  byId("theme").addEventListener("click", () => {
    page.state.theme = isDark(page) ? "light" : "dark";
    dress(page);
    page.remember();
  });
  byId("sheet").addEventListener("click", lift);
  listenToDivider(
    share => page.map.slide(share),
    () => page.state.swipe,
  );
  addEventListener("beforeprint", () => preparePaper(page.state.cells.at ?? page.live.now()));
  byId("tabs").append(
    ...tabs.map(name =>
      make(
        "button",
        {
          type: "button",
          role: "tab",
          id: `tab-${name}`,
          "aria-controls": "panel",
          "aria-selected": "false",
          onclick: () => page.panels.open(name),
        },
        say(`tab.${name}`),
      ),
    ),
  );
  byId("panel").setAttribute("role", "tabpanel");
  markTab(tabs, page.state.tab);
  byId("tabs").addEventListener("keydown", e => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
    if (!step) return;
    page.panels.open(tabs[(tabs.indexOf(page.state.tab) + step + tabs.length) % tabs.length]);
    byId(`tab-${page.state.tab}`).focus();
  });
}
