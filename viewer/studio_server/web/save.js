// A finished run as other kinds of files: for printing, for the web, for augmented reality, to send to somebody.

import { about, ask, attempt, change, h, key, plural } from "./dom.js";

/** The panel of one run; `again` draws the page anew. */
export function saving(name, again) {
  let formats = null, chosen = "", size = "", files = [], timer = 0, isClosed = false;
  const begun = new Map(); // file -> when it was first seen under way, and which share was done then

  ask("/api/formats").then((rows) => {
    formats = rows.filter((one) => one.name !== "html"); // the page is what its own Share makes
    chosen = formats[0].name;
    refresh();
  }, () => {});

  const wish = (one) => ({ key: name, format: one.name, size: one.size });
  const idOf = (one) => `${one.name} ${one.size}`;
  const isSized = () => formats.some((one) => one.name === chosen && one.sized);
  const wanted = () => ({ name: chosen, size: isSized() ? size : "" }); // as it is now: a click may come before the page is drawn anew
  const there = () => files.find((one) => idOf(one) === idOf(wanted()));

  /** Ask what has become of the files; making them is the server's, and goes on when the page is closed. */
  async function refresh() {
    clearTimeout(timer);
    files = (await ask(`/api/saved?key=${key(name)}`).catch(() => files)).slice();
    if (isClosed) return;
    if (files.some((one) => !one.file && !one.error)) timer = setTimeout(refresh, 1000);
    again();
  }

  const addressOf = (one) => `/download?key=${key(name)}&format=${key(one.name)}&size=${key(one.size)}`;
  const make = (one) => attempt(async () => { try { await change("save", wish(one)); } finally { refresh(); } });
  const forget = (one) => attempt(async () => { await change("forget_save", wish(one)); refresh(); });

  function row(one) {
    const words = `${one.title}${one.size ? `, ${one.size} mm` : ""}`;
    const button = (text, act) => h("button", { "aria-label": `${text}: ${words}`, onclick: () => act(one) }, text);
    if (one.error) return h("li", { key: idOf(one) }, h("p", { class: "bad" }, `${words}: ${one.error}`), h("div", { class: "bar" }, button("Try again", make), button("Remove", forget)));
    if (one.file) {
      begun.delete(idOf(one));
      return h("li", { key: idOf(one) }, h("div", { class: "bar" }, h("a", { class: "button main", download: one.file, href: addressOf(one) },
        `Download ${one.file}`), button("Remove", forget)), h("p", { class: "small quiet" }, one.about));
    }
    const isKnown = one.share !== null && one.share !== undefined;
    return h("li", { key: idOf(one) },
      h("p", {}, `${words}: ${isKnown ? `${Math.round(100 * one.share)} %${left(one)}` : "waits, or has just begun"}`),
      h("progress", { max: "1", value: isKnown && one.share, "aria-label": words }), button("Cancel", forget));
  }

  function left(one) {
    const [when, share] = begun.get(idOf(one)) || [Date.now(), one.share];
    begun.set(idOf(one), [when, share]);
    return one.share > share ? `, ${about((Date.now() - when) / 1000 * (1 - one.share) / (one.share - share))} left` : "";
  }

  function panel() {
    if (!formats) return null;
    const kind = formats.find((one) => one.name === chosen), now = there();
    return h("section", { class: "panel save", key: "save" }, h("h2", {}, "Take it with you"),
      h("div", { class: "bar" },
        h("select", { "aria-label": "Kind of file", value: chosen, onchange: (event) => { chosen = event.target.value; again(); } },
          formats.map((one) => h("option", { value: one.name, selected: one.name === chosen }, one.title))),
        kind.sized && h("label", {}, "Longest side ", h("input", { type: "number", min: "1", max: "10000", step: "any", value: size, placeholder: "as it is",
          oninput: (event) => { size = event.target.value; again(); } }), " mm"),
        h("button", { class: "main", key: "make", disabled: Boolean(now && !now.error), onclick: () => make(there() || wanted()) }, "Make the file")),
      h("p", { class: "small quiet" }, kind.about),
      h("ul", { class: "plain files" }, [...files].reverse().map(row)),
      h("p", { class: "hidden", role: "status" }, files.length ? `${plural(files.filter((one) => one.file).length, "file")} to download, ${files.filter((one) => !one.file && !one.error).length} being made` : ""));
  }
  return { panel, close: () => { isClosed = true; clearTimeout(timer); } };
}
