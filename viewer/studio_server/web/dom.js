// Elements, requests and words that all pages share. Text only ever becomes text nodes: nothing that a stranger wrote is markup.

const SVG = new Set(["svg", "circle", "path", "text"]);

/** An element; attributes that begin with "on" are handlers, false and null leave an attribute or child out. */
export function h(tag, attributes = {}, ...children) {
  const element = SVG.has(tag) ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  element.on = {};
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === false || value === null || value === undefined) continue;
    if (name.startsWith("on")) { element[name] = value; element.on[name] = value; }
    else if (name === "key") element.key = value;
    else if (name === "value" || name === "checked") element[name] = value;
    else if (name === "width%") element.style.width = `${value}%`;
    else element.setAttribute(name, value === true ? "" : value);
  }
  for (const child of children.flat(9)) {
    if (child === false || child === null || child === undefined) continue;
    element.append(child instanceof Node ? child : String(child));
  }
  return element;
}

/** Make `old` like `fresh`, keeping elements that are still there: focus, scrolling and what is typed stay. */
export function morph(old, fresh) {
  if (old.nodeType !== fresh.nodeType || old.nodeName !== fresh.nodeName || old.key !== fresh.key) {
    old.replaceWith(fresh);
    return;
  }
  if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== fresh.data) old.data = fresh.data;
    return;
  }
  if (old.stays) return; // an element that looks after itself: a picture, a frame
  for (const name of old.getAttributeNames()) if (!fresh.hasAttribute(name) && name !== "open" && name !== "style") old.removeAttribute(name);
  for (const name of fresh.getAttributeNames()) {
    if (name === "style") continue; // the policy forbids it as an attribute, not as a property
    if (old.getAttribute(name) !== fresh.getAttribute(name)) old.setAttribute(name, fresh.getAttribute(name));
  }
  for (const name of Object.keys(old.on || {})) if (!(fresh.on || {})[name]) old[name] = null;
  for (const [name, value] of Object.entries(fresh.on || {})) old[name] = value;
  old.on = fresh.on;
  if (old.style.cssText !== fresh.style.cssText) old.style.cssText = fresh.style.cssText;
  if (old !== document.activeElement && "value" in fresh && ["INPUT", "SELECT"].includes(old.nodeName) && old.type !== "file") {
    if (old.value !== fresh.value) old.value = fresh.value;
    if (old.checked !== fresh.checked) old.checked = fresh.checked;
  }
  children(old, [...fresh.childNodes]);
}

function children(old, fresh) {
  const keyed = new Map([...old.childNodes].filter((node) => node.key !== undefined).map((node) => [node.key, node]));
  let at = old.firstChild;
  for (const node of fresh) {
    const same = node.key === undefined ? null : keyed.get(node.key);
    if (same && same !== at) { old.insertBefore(same, at); at = same; }
    if (at && (same || (at.key === undefined && node.key === undefined))) {
      const next = at.nextSibling;
      morph(at, node);
      at = next;
    } else old.insertBefore(node, at);
  }
  while (at) { const next = at.nextSibling; at.remove(); at = next; }
}

/** The answer to a question; an Error with the server's sentence where it has one. */
export async function ask(path) {
  return await answered(await fetch(path, { credentials: "same-origin" }));
}

/** Ask for a change. */
export async function change(name, values = {}) {
  const body = JSON.stringify(values);
  const options = { method: "POST", body, headers: { "Content-Type": "application/json" }, credentials: "same-origin" };
  return (await answered(await fetch(`/api/${name}`, options))).done;
}

async function answered(response) {
  const found = await response.json().catch(() => ({}));
  if (response.ok) return found;
  const closed = "This page has no access any more. Open the address that shadowgraph printed.";
  throw new Error(found.error || (response.status === 401 ? closed : `The studio answered ${response.status}.`));
}

/** Do something that may fail; what is wrong becomes a sentence on the page. */
export async function attempt(task) {
  try { return await task(); } catch (error) { toast(error.message, true); return undefined; }
}

/** Ask for a change, and draw the page anew by `again`. */
export const changed = (again) => (name, values) => attempt(async () => { await change(name, values); again(); });

export function toast(words, isBad = false) {
  const element = h("div", { class: isBad ? "toast bad" : "toast" }, words);
  document.getElementById("toasts").append(element);
  setTimeout(() => element.remove(), isBad ? 12000 : 5000);
}

const NOTHING = "data:image/gif;base64,R0lGODlhAQABAAAAACH5BAEKAAEALAAAAAABAAEAAAICTAEAOw=="; // without an address a browser draws a broken picture
const PAUSE_MS = 600, LONGER_MS = 50, TRIES = 100; // until it is asked for anew, longer each time; some minutes in all

/** A picture that may still have to be made; its place stays empty until then. */
export function picture(address, words) {
  let tries = 0;
  const load = () => { if (image.isConnected || !tries) image.src = address; };
  const image = h("img", { loading: "lazy", class: "picture", alt: words, key: address, onerror: () => {
    image.src = NOTHING;
    if (++tries < TRIES) setTimeout(load, PAUSE_MS + LONGER_MS * tries);
  } });
  image.stays = true;
  load();
  return image;
}

/** Ask in a dialog; resolves to the text, to true where none is asked for, or to null. */
export function dialog(title, words, action, { text = null, isDanger = false } = {}) {
  return new Promise((resolve) => {
    const field = text === null ? null : h("input", { type: "text", value: text, "aria-label": title, maxlength: "120" });
    const done = (value) => { box.close(); box.remove(); resolve(value); };
    const submit = () => done(field ? field.value : true);
    const box = h("dialog", { "aria-label": title, oncancel: () => done(null) },
      h("h2", {}, title), words && h("p", {}, words), field,
      h("div", { class: "bar" }, h("button", { onclick: () => done(null) }, "Cancel"),
        h("button", { class: isDanger ? "danger" : "main", onclick: submit }, action)));
    if (field) field.onkeydown = (event) => {
      if (event.key !== "Enter") return;
      event.preventDefault(); // or it would press the button that gets the focus back
      submit();
    };
    document.body.append(box);
    box.showModal();
    if (field) { field.focus(); field.select(); }
  });
}

/** Ask for another title of a capture or run; `again` draws the page anew. */
export const rename = ({ key: place, title: before }, again) => attempt(async () => {
  const title = await dialog(`Rename ${before}`, "", "Rename", { text: before });
  if (title) { await change("rename", { key: place, title }); again(); }
});

export function bytes(count) {
  if (count >= 1e9) return `${(count / 1e9).toFixed(1)} GB`;
  return count >= 1e6 ? `${Math.round(count / 1e6)} MB` : `${Math.ceil(count / 1e3)} kB`;
}

export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  if (whole < 60) return `${whole} s`;
  return whole < 3600 ? `${Math.floor(whole / 60)} min ${whole % 60} s` : `${Math.floor(whole / 3600)} h ${Math.floor(whole % 3600 / 60)} min`;
}

export function about(seconds) {
  if (seconds < 90) return `about ${Math.max(10, Math.round(seconds / 10) * 10)} s`;
  return seconds < 5400 ? `about ${Math.round(seconds / 60)} min` : `about ${(seconds / 3600).toFixed(1)} h`;
}

export function day(seconds) {
  const when = new Date(seconds * 1000);
  return when.toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}

/** How fine a run is: what the pages call the presets, and what each is for. */
export const PRESETS = {
  draft: ["A first look", "Coarse, to see whether the photos are good."],
  standard: ["The usual", "A solid model with its colours."],
  fine: ["All that the photos hold", "Finer, with the relief of every pixel; takes longest."],
};
export const presetWords = (name) => (PRESETS[name] ? PRESETS[name][0] : name);

export const key = encodeURIComponent;
export const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
