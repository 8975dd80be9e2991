// A finished run as another kind of file: for printing, for the web, for augmented reality, to send to somebody.

import { ask, attempt, change, h, key } from "./dom.js";

/** The panel of one run; `again` draws the page anew. */
export function saving(name, again) {
  let formats = null, chosen = "html", size = "", made = null, isAsked = false, timer = 0;

  ask("/api/formats").then((rows) => { formats = rows; again(); }, () => {});

  const forget = () => { made = null; isAsked = false; clearTimeout(timer); };

  /** Ask until the file is there: making it is the server's, and goes on meanwhile. */
  async function make() {
    isAsked = true;
    const wanted = { key: name, format: chosen, size };
    const found = await attempt(() => change("save", wanted));
    if (!isAsked || wanted.format !== chosen || wanted.size !== size) return; // something else was chosen meanwhile
    if (!found) forget();
    else if (found.file) [made, isAsked] = [found, false];
    else timer = setTimeout(make, 1000);
    again();
  }

  function panel() {
    if (!formats) return null;
    const row = formats.find((one) => one.name === chosen) || formats[0];
    return h("section", { class: "panel save", key: "save" }, h("h2", {}, "Take it with you"),
      h("div", { class: "bar" },
        h("select", { "aria-label": "Kind of file", value: chosen, onchange: (event) => { forget(); chosen = event.target.value; again(); } },
          formats.map((one) => h("option", { value: one.name, selected: one.name === chosen }, one.title))),
        row.sized && h("label", {}, "Longest side ", h("input", { type: "number", min: "1", max: "10000", step: "any", value: size, placeholder: "as it is",
          onchange: (event) => { forget(); size = event.target.value; again(); } }), " mm"),
        made ? h("a", { class: "button main", key: "download", download: made.file, href: `/download?key=${key(name)}&format=${key(chosen)}&size=${key(size)}` }, `Download ${made.file}`)
          : h("button", { class: "main", key: "make", disabled: isAsked, onclick: () => { make(); again(); } }, isAsked ? "Being made" : "Make the file")),
      h("p", { class: "small quiet", role: "status" }, made ? `${made.file}: ${made.about}` : isAsked ? "Some seconds; a video takes minutes." : row.about));
  }
  return { panel, close: forget };
}
