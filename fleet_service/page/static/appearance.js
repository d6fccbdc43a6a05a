// Appearance of the page: light or dark, height of the sheet on a phone, divider of a comparison,
// printing.
import { setTheme } from "./colours.js";
import { byId, make } from "./elements.js";
import { ladder, mapKey } from "./legend.js";
import { clock, say, zone } from "./texts.js";

// heights of the sheet: half of the screen, most of it, or a strip
const HEIGHTS = ["44%", "86%", "9.5rem"];

const device = matchMedia("(prefers-color-scheme: dark)");

/** Return true if the page is dark: by the user's choice, or else by the device's setting. */
export const isDark = page => (page.state.theme ?? (device.matches ? "dark" : "light")) === "dark";

/** Call `changed` when the device changes between light and dark. */
export const onDeviceTheme = changed => device.addEventListener("change", changed);

/** Set the colours of document and map to light or dark. Return the name of the theme. */
export function applyTheme(page) {
  const name = isDark(page) ? "dark" : "light";
  document.documentElement.dataset.theme = name;
  setTheme(name);
  return name;
}

/** Apply the theme to everything that depends on it: the button, the map's legend and the map. */
export function dress(page) {
  const name = applyTheme(page);
  Object.assign(byId("theme"), {
    textContent: name === "dark" ? "☀" : "☾",
    title: say(`theme.${name}`),
    ariaLabel: say(`theme.${name}`),
  });
  byId("sheet").ariaLabel = say("sheet.more");
  mapKey();
  page.map.draw();
}

export function lift() {
  const style = document.documentElement.style;
  const now = style.getPropertyValue("--covered") || HEIGHTS[0];
  const next = HEIGHTS[(HEIGHTS.indexOf(now) + 1) % HEIGHTS.length];
  style.setProperty("--covered", next);
  Object.assign(byId("sheet"), {
    ariaLabel: say(next === HEIGHTS[1] ? "sheet.less" : "sheet.more"),
    ariaExpanded: String(next !== HEIGHTS[2]),
  });
}

// Move the divider between two moments that are drawn in the same place. Return the share that was
// set.
export function moveDivider(share) {
  const kept = Math.min(0.98, Math.max(0.02, share));
  const percent = Math.round(100 * kept);
  byId("beside").style.clipPath = `inset(0 0 0 ${percent}%)`;
  byId("divider").style.left = `${percent}%`;
  byId("divider").setAttribute("aria-valuenow", percent);
  return kept;
}

export function listenToDivider(slide, share) {
  const divider = byId("divider");
  const view = byId("view");
  divider.setAttribute("aria-label", say("time.swipe"));
  divider.addEventListener("pointerdown", e => divider.setPointerCapture(e.pointerId));
  divider.addEventListener("pointermove", e => {
    if (divider.hasPointerCapture(e.pointerId))
      slide((e.clientX - view.getBoundingClientRect().left) / view.clientWidth);
  });
  divider.addEventListener("keydown", e => {
    const step = { ArrowLeft: -0.05, ArrowRight: 0.05 }[e.key];
    if (!step) return;
    slide(share() + step);
    e.preventDefault();
  });
}

// Add what a printed page needs: the moment with its time zone, and the legend.
export function preparePaper(at) {
  byId("paper")?.remove();
  byId("side").append(
    make(
      "section",
      { id: "paper" },
      make("h2", {}, say("print.head", { moment: clock(at), zone: zone(at) })),
      ladder(),
    ),
  );
}
