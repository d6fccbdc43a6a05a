// States without a map: loading, empty, no service, no network, no answer. Each has a text and the
// next step.
import { byId, make } from "./elements.js";
import { say } from "./texts.js";

const SILENT_MS = 6000;
// silence that counts as an error; time after which a starting page shows "loading"
const SLOW_MS = 800;

export function stateOf({ live, state: { now }, map: { asked } }) {
  if (!asked) return performance.now() > SLOW_MS ? "loading" : null;
  if (!live.state) return now.known.size ? null : "loading";
  if (performance.now() - live.beaten > SILENT_MS) return "error";
  if (now.known.size) return null;
  if (!live.state.router) return "no_router";
  return live.state.served ? "empty" : "no_service";
}

export function stateCard(page) {
  const state = stateOf(page);
  const card = byId("card");
  if (card.dataset.state === (state ?? "")) return;
  card.dataset.state = document.body.dataset.state = state ?? "";
  card.hidden = !state;
  const words = { loading: ["card.loading"], error: [null, "card.error"] }[state] ?? [
    `card.${state}`,
    `card.${state}.text`,
    `card.${state}.command`,
  ];
  card.replaceChildren(
    ...(state
      ? [
          words[0] && make("h2", {}, say(words[0])),
          words[1] && make("p", {}, say(words[1])),
          words[2] && make("code", {}, say(words[2])),
        ].filter(Boolean)
      : []),
  );
}
