// One capture: its board, its photos as they arrive, the verdict, and the start of a run.

import { PRESETS, about, ask as question, attempt, bytes, change, changed, day, dialog, duration, h, key, picture, plural, presetWords, rename, toast } from "./dom.js";
import { boardOnScreen, printLink } from "./board.js";
import { dome } from "./hemisphere.js";
import { Sender, chooser, complaint, dropped, sending, unused } from "./upload.js";
import { voice } from "./voice.js";

const ROLES = { "": "find out", board: "board", lit: "flashlight", light: "flashlight's phone", dark: "light off", side: "side photo" };
const FOLDERS = { board: "board/", lit: "photos/", light: "light/", dark: "dark/", side: "side/" };
const senders = new Map(); // they go on while another view is shown

export function capture(name, again) {
  if (!senders.has(name)) senders.set(name, new Sender(name, () => window.dispatchEvent(new Event("sent"))));
  const sender = senders.get(name);
  const phone = phones(name, again), act = changed(again), take = (files) => sender.add(files);
  let boards = null, times = [], timed = -1, preset = "draft", isOver = false;
  const loud = voice(again);
  const view = { pause: 1000 };
  let last = 0;
  addEventListener("sent", view.onsent = () => { if (Date.now() - last > 400) { last = Date.now(); again(); } });
  view.close = () => removeEventListener("sent", view.onsent);

  view.render = async (ask) => {
    const row = await ask(`/api/capture?key=${key(name)}`);
    boards = boards || await ask("/api/boards");
    if (timed !== row.photos.length && !row.coming && !sender.open.length) {
      const found = (await question(`/api/presets?key=${key(name)}`).catch(() => ({ presets: [] }))).presets;
      if (found.length) [times, timed] = [found, row.photos.length];
    }
    await phone.refresh();
    view.pause = row.photos.some((photo) => !photo.looked) ? 400 : 1000; // what is wrong with a new photo is said soon
    document.title = `${row.title} · Shadowgraph studio`;
    return [
      h("div", { class: "bar" }, h("h1", { class: "grow" }, row.title), h("button", { onclick: () => rename(row, again) }, "Rename"),
        h("a", { class: "button", href: "#/" }, "All captures")),
      h("div", { class: "columns" },
        h("div", {}, photosPanel(row), boardPanel(row)),
        h("div", {}, verdictPanel(row), startPanel(row), runsPanel(row))),
    ];
  };

  function photosPanel(row) {
    const bad = row.photos.filter((photo) => photo.drop);
    const over = (is) => (event) => { event.preventDefault(); if (is !== isOver) { isOver = is; again(); } };
    return h("section", { class: "panel" }, h("h2", {}, "Photos"),
      h("div", { class: isOver ? "drop over" : "drop", ondragover: over(true), ondragleave: over(false), ondrop: async (event) => {
        event.preventDefault();
        isOver = false;
        sender.add(await dropped(event.dataTransfer));
      } },
        h("p", {}, "Drop photos, a folder, a .zip or a clip here: the board in room light, and the object under the flashlight."),
        h("div", { class: "bar" }, chooser("Choose files", {}, take), chooser("Choose a folder", { webkitdirectory: true }, take), phone.button())),
      phone.panel(), sending(sender), row.stalled > 0 && stalled(row),
      row.refused.length > 0 && h("div", { class: "bad small" }, h("p", {}, "Not taken:"),
        h("ul", { class: "plain" }, row.refused.slice(-5).map((one) => h("li", {}, complaint(one.name, one.why), " ",
          h("button", { onclick: () => act("dismiss", { key: row.key, part: one.id }) }, "Dismiss")))),
        row.refused.length > 5 && h("p", {}, `and ${row.refused.length - 5} more.`)),
      row.photos.length + row.clips.length > 0 && h("p", { class: "quiet" }, row.counts.words),
      bad.length > 0 && h("p", { class: "warn" }, unused(bad)),
      row.clips.map((clip) => h("p", { key: clip }, `Clip: ${clip}`)),
      h("ul", { class: "photos" }, row.photos.map((photo) => thumb(row, photo))));
  }

  /** Files whose sender has left in the middle: they keep a run from starting. */
  function stalled(row) {
    return h("div", { class: "warn", key: "stalled" },
      h("p", {}, `${plural(row.stalled, "file")} stopped in the middle: the phone or page that sends ${row.stalled === 1 ? "it" : "them"} has left, or lost the network. Sending goes on by itself when it is back.`),
      h("button", { onclick: () => act("go_on_without", { key: row.key }) }, "Go on without"));
  }

  /** What a photo may show. Of one in the folder of a role the folder says it, and another choice moves it there. */
  function roles(photo) {
    const unknown = photo.looked && !photo.role ? "not clear yet" : ROLES[""];
    return Object.entries(ROLES).filter(([role]) => role || !photo.by_folder).map(([role, words]) =>
      h("option", { value: role, selected: role === photo.role }, role === "" ? unknown : photo.by_folder ? FOLDERS[role] : words));
  }

  function thumb(row, photo) {
    const said = photo.remarks.map(([kind, text]) => `${kind}: ${text}`).join("; ");
    return h("li", { class: photo.drop ? "out" : photo.remarks.length ? "remark" : "", key: photo.name, title: said || photo.name },
      picture(`/api/picture?key=${key(row.key)}&photo=${key(photo.name)}`, photo.name),
      h("span", { class: "name" }, photo.name.split("/").pop()),
      photo.remarks.length > 0 && h("span", { class: photo.drop ? "bad" : "warn" }, photo.remarks[0][0]),
      h("select", { "aria-label": `What ${photo.name} shows`, value: photo.role, onchange: (event) => act("role", { key: row.key, photo: photo.name, role: event.target.value }) }, roles(photo)),
      h("button", { "aria-label": `Delete ${photo.name}`, onclick: () => attempt(async () => {
        await change("delete_photo", { key: row.key, photo: photo.name });
        toast(`${photo.name} is in the trash.`);
        again();
      }) }, "×"));
  }

  function boardPanel(row) {
    const known = boards.some((board) => board.spec === row.board);
    const list = known ? boards : [...boards, { spec: row.board, title: row.board, about: "As session.toml says." }];
    const choose = (spec) => act("board", { key: row.key, board: spec });
    const printed = row.board.startsWith("paper") || row.board === "card" ? "" : row.board;
    const chosen = list.find((board) => board.spec === row.board).title, isClosed = row.photos.length + row.clips.length > 0;
    const place = (...parts) => (isClosed ? h("details", { class: "panel" }, h("summary", {}, h("h2", {}, `Board: ${chosen}`)), parts)
      : h("section", { class: "panel" }, h("h2", {}, "Board"), parts));
    return place(
      h("p", { class: "quiet" }, "It tells how large things are. It lies flat where the object will stand, in a photo from the tripod in room light."),
      h("fieldset", { class: "choice", "aria-label": "Board" }, list.map((board) => h("label", { key: board.spec || "auto" },
        h("input", { type: "radio", name: "board", checked: board.spec === row.board, value: board.spec || "auto", onchange: () => choose(board.spec) }),
        h("b", {}, board.title), h("div", { class: "small quiet" }, board.about)))),
      h("div", { class: "bar" }, printLink(printed, "a4", "Print on A4"), printLink(printed, "letter", "Print on US letter"),
        h("button", { onclick: () => boardOnScreen(printed) }, "Show on a screen"),
        h("button", { onclick: () => describe(row) }, "Another board")),
      h("p", { class: "small quiet" }, "Print at 100 %, not fitted to the page, measure its ruler, and glue it to something flat."));
  }

  const describe = (row) => attempt(async () => {
    const words = "Such as charuco:5x7:30:22:DICT_4X4_50 (squares, mm of a square, mm of a marker, dictionary) or checkerboard:9x6:24.25 (inner corners, mm of a square).";
    const spec = await dialog("Another board", words, "Use it", { text: row.board });
    if (spec !== null) await act("board", { key: row.key, board: spec.trim() });
  });

  function verdictPanel(row) {
    const check = row.check;
    const lights = check.lights.length && !check.is_old ? check.lights : row.coach.lights.map((light) => ({ ...light, used: true }));
    loud.hear(row.photos.filter((photo) => photo.drop), row.coach.advice);
    const isPending = check.is_running || (check.is_old && row.photos.length + row.clips.length > 4);
    return h("section", { class: "panel", "aria-live": "polite" }, h("h2", {}, "Are the photos good?"),
      row.photos.length + row.clips.length === 0 && h("p", { class: "quiet" }, "Photos first: 15 to 40 of the object, each with the light elsewhere."),
      isPending && h("p", { class: "quiet" }, check.is_running ? "Looking at all photos together." : "Waits until no more photos arrive."),
      check.sentence && h("p", { class: `verdict ${check.verdict}` }, check.sentence),
      !check.sentence && check.error && h("p", { class: "verdict bad" }, check.error),
      check.advice.length > 0 && h("div", {}, h("h3", {}, "Shoot next"), h("ul", { class: "plain" }, check.advice.map((text) => h("li", {}, text)))),
      check.reasons.length > 1 && h("details", {}, h("summary", {}, "Why"), h("ul", { class: "plain" }, check.reasons.map((text) => h("li", {}, text)))),
      row.coach.advice && (check.is_old || !check.sentence) && h("p", { class: "verdict" }, row.coach.advice),
      lights.length > 0 && dome(lights),
      lights.length > 0 && h("p", { class: "small quiet" }, "The lights seen from above: low ones at the rim. No light yet where it glows."),
      row.photos.length > 0 && loud.control(),
      h("div", { class: "bar" }, h("button", { disabled: check.is_running || row.photos.length + row.clips.length < 2, onclick: () => act("check", { key: row.key }) }, "Check now"),
        check.sentence && h("a", { class: "button", href: `/check_page?key=${key(row.key)}`, target: "_blank", rel: "noopener" }, "All details")));
  }

  function startPanel(row) {
    const time = Object.fromEntries(times.map((one) => [one.name, one])), isEmpty = row.photos.length + row.clips.length === 0;
    return h("section", { class: "panel" }, h("h2", {}, "Reconstruct"),
      h("fieldset", { class: "choice", "aria-label": "How fine" }, Object.entries(PRESETS).map(([value, [title, words]]) => h("label", { key: value },
        h("input", { type: "radio", name: "preset", value, checked: value === preset, onchange: () => { preset = value; again(); } }),
        h("b", {}, title), h("div", { class: "small quiet" }, words, " ",
          time[value] ? `Takes ${about(time[value].seconds)} here, and ${bytes(time[value].bytes)} of memory${time[value].fits ? "" : ": more than is free"}.` : !isEmpty && "Measuring this machine.")))),
      h("button", { class: "main", disabled: isEmpty || sender.open.length > 0 || row.coming > 0, onclick: () => start(row) }, row.clips.length ? "Start" : row.counts.start),
      row.counts.uses && !row.clips.length && h("p", { class: "quiet small" }, row.counts.uses),
      isEmpty ? h("p", { class: "quiet small" }, "Photos first.")
        : (sender.open.length > 0 || row.coming > 0) && h("p", { class: "quiet small" }, "Starts once all photos are here."),
      row.check.verdict === "hopeless" && h("p", { class: "warn small" }, "These photos will not do, as the verdict says: a run would stop there."));
  }

  const start = (row) => attempt(async () => {
    const run = await change("start", { key: row.key, preset });
    location.hash = `#/run/${key(run)}`;
  });

  function runsPanel(row) {
    if (!row.runs.length) return null;
    return h("section", { class: "panel" }, h("h2", {}, "Runs"), h("ul", { class: "plain" }, row.runs.map((run) => h("li", { key: run.key },
      h("a", { href: `#/run/${key(run.key)}` }, run.title === row.title ? presetWords(run.preset) : run.title), ` ${run.state}`, run.state === "running" && `, ${Math.round(100 * run.progress.share)} %`,
      run.size && `, ${run.size}`, h("span", { class: "quiet small" }, ` ${run.state === "finished" ? duration(run.progress.elapsed_s) : day(run.date)}`),
      run.state === "failed" && h("div", { class: "bad small" }, run.sentence)))));
  }

  return view;
}

const DOES = { camera: " photographs", light: " holds the light" };

/** Phones that are let in: the switch, the code to scan, who is there. */
function phones(capture, again) {
  let row = { on: false, phones: [] }, isLive = false;
  const turn = (name, values) => attempt(async () => { await change(name, values); await refresh(); again(); });
  const refresh = async () => { row = await question("/api/phones"); };

  return {
    refresh,
    button: () => h("button", { "aria-pressed": String(row.on && row.capture === capture), onclick: () => (row.on && row.capture === capture ? turn("send_away", {}) : turn("let_in", { key: capture })) },
      row.on && row.capture === capture ? "Disconnect phones" : "Let phones in"),
    panel: () => {
      if (!row.on || row.capture !== capture) return null;
      const address = isLive ? row.live_address : row.address;
      return h("div", { class: "panel", key: "phones" }, h("h3", {}, "Scan this with the phone's camera"),
        h("div", { class: "bar" },
          h("img", { class: "qr", src: `/api/code?${isLive ? "live&" : ""}v=${key(address)}`, alt: "Code with the address for the phone" }),
          h("div", { class: "grow" },
            h("p", {}, "The phone must be on the same network. Each code lets one phone in; the next one shows at once. Photos travel unencrypted on your network."),
            h("p", { class: "small" }, "Or open ", h("code", {}, address)),
            h("label", {}, h("input", { type: "checkbox", checked: isLive, onchange: (event) => { isLive = event.target.checked; again(); } }),
              " Live camera (https). The phone warns, because this machine signs for itself: choose Advanced, then Proceed."),
            row.phones.length === 0 && h("p", {}, "No phone yet."),
            row.phones.length > 0 && h("ul", { class: "plain" }, row.phones.map((one, k) => h("li", {}, `Phone ${k + 1} (${one.name})${DOES[one.role] || ""}${one.is_here ? "" : ", not connected: it goes on sending when it is back"}`))),
            row.phones.some((one) => one.role === "camera") && h("button", { class: "main", onclick: () => turn("shoot", {}) }, "Take a photo"),
            h("p", { class: "small quiet" }, `Closes by itself in ${duration(row.left_s)}.`))));
    },
  };
}
