// All texts of the page: one table per language, such as texts.en.json. The server selects it by
// the browser's language.
let table = {};

export async function loadTexts() {
  table = await (await fetch("/texts")).json();
  document.documentElement.lang = table["language"];
}

// Fill in a text. In "{count} {count|region|regions}" the second part is the singular or the plural
// form.
export function say(key, values = {}) {
  const text = table[key] ?? key;
  return text.replace(/\{(\w+)(?:\|([^|}]*)\|([^}]*))?\}/g, (_, name, one, many) =>
    one === undefined ? String(values[name] ?? "") : values[name] === 1 ? one : many,
  );
}

export function ago(seconds) {
  const s = Math.max(0, seconds);
  if (s < 100) return say("ago.seconds", { n: Math.round(s) });
  if (s < 5400) return say("ago.minutes", { n: Math.round(s / 60) });
  if (s < 129600) return say("ago.hours", { n: Math.round(s / 3600) });
  return say("ago.days", { n: Math.round(s / 86400) });
}

export function clock(seconds) {
  const at = new Date(seconds * 1000);
  const two = n => String(n).padStart(2, "0");
  const date = [at.getFullYear(), two(at.getMonth() + 1), two(at.getDate())].join("-");
  return `${date} ${[at.getHours(), at.getMinutes(), at.getSeconds()].map(two).join(":")}`;
}

// Return the browser's time zone at a moment.
export function zone(seconds = Date.now() / 1000) {
  const minutes = -new Date(seconds * 1000).getTimezoneOffset();
  const two = n => String(n).padStart(2, "0");
  const size = Math.abs(minutes);
  return minutes === 0
    ? "UTC"
    : `UTC${minutes < 0 ? "−" : "+"}${two(Math.floor(size / 60))}:${two(size % 60)}`;
}
