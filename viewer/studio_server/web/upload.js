// Files to a capture, in pieces that survive dropped connections and servers that were killed: tus 1.0.0 (tus.io).

import { h } from "./dom.js";

const VERSION = { "Tus-Resumable": "1.0.0" };
const PIECE = 4 << 20; // bytes: some seconds of a slow WLAN
const AT_ONCE = 3;
const PATIENCE_MS = 30 * 60 * 1000; // without a byte that arrives, after which a file is given up

/** Sends files one after the other, some at a time; `changed` is called whenever something did. */
export class Sender {
  constructor(capture, changed) {
    Object.assign(this, { capture, changed, files: [], active: 0 });
  }

  /** Add files: {file, path}. The same file twice is sent once. */
  add(entries, role = "") {
    for (const { file, path } of entries) {
      const name = `${path}|${file.size}|${file.lastModified}`;
      if (this.files.some((one) => one.name === name && !one.failed)) continue;
      this.files.push({ name, file, path, role, sent: 0, done: false, failed: "", address: "" });
    }
    this.work();
  }

  get open() { return this.files.filter((one) => !one.done && !one.failed); }
  get failed() { return this.files.filter((one) => one.failed); }
  get stuck() { return this.failed.filter((one) => !one.isFinal); }
  get total() { return this.files.reduce((sum, one) => sum + one.file.size, 0); }
  get sent() { return this.files.reduce((sum, one) => sum + (one.done ? one.file.size : one.sent), 0); }

  work() {
    while (this.active < AT_ONCE) {
      const next = this.files.find((one) => !one.done && !one.failed && !one.busy);
      if (!next) break;
      next.busy = true;
      this.active += 1;
      send(next, this.capture, this.changed).catch((error) => { Object.assign(next, { failed: error.message, isFinal: Boolean(error.isFinal) }); }).finally(() => {
        next.busy = false;
        this.active -= 1;
        this.changed();
        this.work();
      });
    }
    this.changed();
  }

  again() {
    for (const one of this.stuck) { one.failed = ""; one.address = ""; one.sent = 0; }
    this.work();
  }

  dismiss() {
    this.files = this.files.filter((one) => !one.failed);
    this.changed();
  }
}

async function send(one, capture, changed) {
  let last = Date.now(), pause = 300;
  for (;;) {
    try {
      if (!one.address) one.address = await create(one, capture);
      const where = await offset(one.address);
      if (where === null) { one.address = ""; continue; } // forgotten: from the start
      if (where > one.sent) last = Date.now();
      one.sent = where;
      while (one.sent < one.file.size) {
        one.sent = await piece(one);
        [last, pause] = [Date.now(), 300];
        changed();
      }
      one.done = true;
      return;
    } catch (error) {
      if (error instanceof Refused) throw error; // sending the same again would end the same
      if (Date.now() - last > PATIENCE_MS) throw new Error("the studio could not be reached for half an hour");
      await new Promise((resolve) => setTimeout(resolve, pause));
      pause = Math.min(2 * pause, 8000);
    }
  }
}

class Refused extends Error {
  constructor(words, isFinal) { super(words); this.isFinal = isFinal; }
}

const base64 = (text) => btoa(String.fromCharCode(...new TextEncoder().encode(text)));

async function create(one, capture) {
  const values = { filename: one.path, capture, role: one.role };
  const metadata = Object.entries(values).filter(([, value]) => value).map(([name, value]) => `${name} ${base64(value)}`);
  const headers = { ...VERSION, "Upload-Length": String(one.file.size), "Upload-Metadata": metadata.join(",") };
  const response = await fetch("/upload", { method: "POST", headers, credentials: "same-origin" });
  await refuse(response);
  return response.headers.get("Location");
}

async function offset(address) {
  const response = await fetch(address, { method: "HEAD", headers: VERSION, credentials: "same-origin" });
  if (response.status === 404) return null;
  await refuse(response);
  return Number(response.headers.get("Upload-Offset"));
}

async function piece(one) {
  const headers = { ...VERSION, "Upload-Offset": String(one.sent), "Content-Type": "application/offset+octet-stream" };
  const body = one.file.slice(one.sent, one.sent + PIECE);
  const response = await fetch(one.address, { method: "PATCH", headers, body, credentials: "same-origin" });
  if (response.status === 409) return Number(response.headers.get("Upload-Offset"));
  await refuse(response);
  one.isListed = response.headers.has("Shadowgraph-Refused"); // the studio says why, in the list of its page
  return Number(response.headers.get("Upload-Offset"));
}

async function refuse(response) {
  if (response.ok) return;
  const found = await response.json().catch(() => ({}));
  if ([400, 401, 403, 507].includes(response.status) && (found.error || response.status !== 400)) {
    const full = "the studio's disk is full: make room there, and send it again";  // the answer to HEAD has no text
    const closed = "this page has no access any more; scan the new code, or open the printed address";
    throw new Refused(found.error || (response.status === 507 ? full : closed), response.status === 400);
  }
  throw new Error(`answer ${response.status}`);
}

/** The files of a drop, of folders in it, too, with their paths. */
export async function dropped(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
  if (!entries.length) return [...transfer.files].map((file) => ({ file, path: file.name }));
  const found = [];
  for (const entry of entries) await walk(entry, "", found);
  return found;
}

async function walk(entry, place, found) {
  if (entry.name.startsWith(".") || entry.name === "gt" || entry.name === "__MACOSX") return;
  const path = place ? `${place}/${entry.name}` : entry.name;
  if (entry.isFile) {
    found.push({ file: await new Promise((resolve, reject) => entry.file(resolve, reject)), path });
    return;
  }
  const reader = entry.createReader();
  for (;;) {
    const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!some.length) return;
    for (const one of some) await walk(one, path, found);
  }
}

/** A button that lets a person choose files: {file, path}, for `take`; `more`: attributes of the input. */
export function chooser(words, more, take, kind = null) {
  const input = h("input", { type: "file", multiple: true, hidden: true, "aria-hidden": "true", tabindex: "-1", ...more,
    onchange: (event) => { take(picked(event.target)); event.target.value = ""; } });
  return h("span", { class: "chooser" }, input, h("button", { class: kind, onclick: (event) => event.currentTarget.parentNode.querySelector("input").click() }, words));
}

function picked(input) {
  return [...input.files].map((file) => ({ file, path: file.webkitRelativePath || file.name })).filter(
    ({ path }) => !path.split("/").some((part) => part.startsWith(".") || part === "gt" || part === "__MACOSX"));
}

/** A bar for what is on its way, and what was not taken. */
export function sending(sender) {
  if (!sender.files.length) return null;
  const share = sender.total ? sender.sent / sender.total : 1, files = sender.files.filter((one) => !one.isListed && !one.isFinal);
  const done = files.filter((one) => one.done).length;
  return h("div", { "aria-live": "polite" },
    sender.open.length > 0 && h("progress", { max: "1", value: share, "aria-label": "Files on their way" }),
    files.length > 0 && h("p", {}, `${done} of ${files.length} files are here${sender.open.length ? `, ${Math.round(100 * share)} %` : "."}`),
    sender.failed.length > 0 && h("div", { class: "bad small" }, h("p", {}, "Not taken:"),
      h("ul", { class: "plain" }, sender.failed.slice(0, 6).map((one) => h("li", {}, complaint(one.path, one.failed)))),
      sender.failed.length > 6 && h("p", {}, `and ${sender.failed.length - 6} more.`),
      h("div", { class: "bar" }, sender.stuck.length > 0 && h("button", { onclick: () => sender.again() }, "Try again"),
        h("button", { onclick: () => sender.dismiss() }, "Dismiss"))));
}

/** What is wrong with a file, which is named once. */
export function complaint(path, why) {
  const name = path.split("/").pop();
  return why.startsWith(name) ? why : `${name}: ${why}`;
}

/** Which photos will not be used, the newest by name: a copy needs no other photo, what is blurred does. */
export function unused(photos) {
  const named = photos.slice(-4).map((one) => `${one.name.split("/").pop()} (${one.remarks[0][0]})`);
  return `Will not be used: ${named.join(", ")}${photos.length > named.length ? `, and ${photos.length - named.length} more` : ""}.`;
}
