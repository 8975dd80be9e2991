// What axe calls serious: controls without a name, pictures without alt, text of too little contrast, ids twice,
// no language, not one main heading; and a page that scrolls sideways. Returns what is wrong, in words.
() => {
  const bad = [], shown = (e) => { const r = e.getBoundingClientRect(); return e.checkVisibility() && r.width > 0 && r.height > 0; };
  const name = (e) => (e.getAttribute("aria-label") || e.innerText || [...(e.labels || [])].map((l) => l.innerText).join("")
    || e.placeholder || [...e.querySelectorAll("img")].map((i) => i.alt).join("")).trim();
  for (const e of document.querySelectorAll("button,a[href],input,select,summary"))
    if (shown(e) && e.getAttribute("aria-hidden") !== "true" && !name(e)) bad.push("no name: " + e.outerHTML.slice(0, 99));
  for (const e of document.querySelectorAll("img:not([alt])")) bad.push("no alt: " + e.outerHTML.slice(0, 99));
  for (const e of document.querySelectorAll("iframe:not([title])")) bad.push("frame without title");
  const ids = [...document.querySelectorAll("[id]")].map((e) => e.id);
  if (new Set(ids).size !== ids.length) bad.push("an id twice");
  if (!document.documentElement.lang || !document.title) bad.push("no language or title");
  if (document.querySelectorAll("h1").length !== 1) bad.push("not one h1");
  if (document.documentElement.scrollWidth > innerWidth + 1) bad.push("scrolls sideways");
  const light = (c) => { const [r, g, b] = c.map((v) => (v / 255 <= 0.03928 ? v / 3294.6 : ((v / 255 + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const colour = (text) => { const m = text.match(/[\d.]+/g).map(Number); return m.length > 3 && m[3] < 0.5 ? null : m.slice(0, 3); };
  const behind = (e) => { for (; e; e = e.parentElement) { const c = colour(getComputedStyle(e).backgroundColor); if (c) return c; }
    return [255, 255, 255]; };
  for (const e of document.querySelectorAll("body *")) {
    if (!shown(e) || e.closest("svg") || !(e.placeholder || [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()))) continue;
    const front = colour(getComputedStyle(e, e.placeholder ? "::placeholder" : null).color);
    if (!front) continue;
    const [a, b] = [light(front), light(behind(e))].sort((x, y) => y - x);
    if ((a + 0.05) / (b + 0.05) < 4.5) bad.push("contrast: " + (e.placeholder || e.innerText).slice(0, 40));
  }
  return bad;
}
