// All captures and runs of the folder.

import { attempt, bytes, change, changed, day, dialog, duration, h, key, picture, plural, presetWords, rename, toast } from "./dom.js";
import { frame, queue } from "./result.js";

const WORDS = {
  arriving: "Photos are arriving", checking: "Being checked", checked: "Checked", new: "New", waiting: "In the queue",
  running: "Running", finished: "Finished", failed: "Failed", stopped: "Stopped",
};

export function home(_, again) {
  let wanted = "";
  const view = { pause: 1500 };

  view.render = async (ask) => {
    const state = await ask("/api/state");
    document.title = "Shadowgraph studio";
    const place = document.getElementById("place");
    place.title = state.folder;
    place.replaceChildren(h("span", { class: "far" }, state.folder.replace(/[^/\\]+$/, "")), `${state.folder.split(/[/\\]/).pop()} · ${bytes(state.free)} free`);
    const busy = state.queue.length > 0 || state.cards.some((card) => ["arriving", "checking"].includes(card.state));
    view.pause = busy ? 1000 : 2500;
    const isEmpty = state.cards.length === 0;
    const cards = state.cards.filter((card) => matches(card, wanted));
    return [
      h("div", { class: "bar" }, h("h1", { class: "grow" }, "Captures"),
        isEmpty ? null : h("input", { type: "search", placeholder: "Search", "aria-label": "Search captures", value: wanted,
          oninput: (event) => { wanted = event.target.value.toLowerCase(); again(); } }),
        isEmpty ? null : h("button", { class: "main", onclick: fresh }, "New capture"),
        isEmpty ? null : h("button", { onclick: () => choose(ask, again) }, "Add a folder")),
      state.free < 2 * state.keep_free && h("p", { class: "warn" },
        `The disk has ${bytes(state.free)} free; runs need more. Empty the trash, or make room.`),
      queue(state.queue, again),
      isEmpty ? empty(ask) : cards.length === 0 ? h("p", { class: "quiet" }, `Nothing is called "${wanted}".`) : null,
      h("ul", { class: "cards" }, cards.map((card) => tile(card))),
      trash(state.trash),
    ].filter(Boolean);
  };

  const fresh = () => attempt(async () => {
    const title = await dialog("New capture", "What is it? A name helps to find it again.", "Create", { text: "" });
    if (title !== null) location.hash = `#/capture/${key(await change("new", { title: title.trim() || "Capture" }))}`;
  });

  const tryExample = () => attempt(async () => { location.hash = `#/run/${key(await change("try_example"))}`; });

  function empty(ask) {
    return h("section", { class: "panel pair welcome" }, h("div", { class: "shown" }, frame("/example/", "An example, to relight and turn"),
      h("p", { class: "small quiet" }, "Made from 36 photos. Move over it: the light follows. Drag to turn it.")),
    h("div", {}, h("h2", {}, "From photos to a 3D model"),
      h("p", {}, "Shadowgraph makes a solid, measured model of an object from photos of it and its shadows. It takes a camera or phone on a tripod, a flashlight, and a room that can be made dark."),
      h("div", { class: "bar" }, h("button", { class: "main", onclick: fresh }, "New capture"),
        h("button", { onclick: tryExample }, "Try the example"),
        h("button", { onclick: () => choose(ask, again) }, "Add a folder")),
      h("p", { class: "small quiet" }, "The example uses photos that come with the program, and takes a minute or two."),
      h("ol", { class: "plain steps" },
        h("li", {}, h("b", {}, "Board. "), "Print a page with squares, or take a blank sheet of paper: it gives the scale. Photograph it on the table in room light."),
        h("li", {}, h("b", {}, "Photos. "), "Put the object on the table, make the room dark, and take 15 to 40 photos; hold the flashlight in another place for each."),
        h("li", {}, h("b", {}, "Model. "), "Bring the photos here. You are told whether they are good, and what to photograph next; then start."))));
  }

  function tile(card) {
    const run = card.runs.find((one) => one.state === "running") || card.runs[0];
    const shown = card.runs.find((one) => one.state === "finished" && one.has_mesh);
    const href = card.kind === "capture" ? `#/capture/${key(card.key)}` : `#/run/${key(card.key)}`;
    const face = shown ? picture(`/api/run_picture?key=${key(shown.key)}&v=${shown.date}`, `${card.title}, reconstructed`)
      : card.count ? picture(`/api/picture?key=${key(card.key)}&v=${card.date}`, `Photo of ${card.title}`)
        : h("div", { class: "picture empty" }, card.kind === "capture" ? "No photos yet" : "No picture yet");
    const state = run && ["waiting", "running", "failed"].includes(run.state) && card.state !== "arriving" ? run.state
      : ["checked", "new"].includes(card.state) && shown ? "finished" : card.state || (run && run.state);
    const judged = state === "finished" && shown ? shown : card;
    return h("li", { class: "card", key: card.key },
      h("a", { class: "face", href: shown ? `#/run/${key(shown.key)}` : href, "aria-hidden": "true", tabindex: "-1" }, face),
      h("div", { class: "body" },
        h("h2", {}, h("a", { href }, card.title)),
        h("p", {}, h("span", { class: `tag ${state === "failed" ? "bad" : ""}` }, WORDS[state] || state), " ",
          judged.verdict && h("span", { class: `tag ${judged.verdict}` }, judged.verdict)),
        words(card, run, state, judged),
        h("p", { class: "small quiet" }, [card.count ? plural(card.count, "photo") : null, shown && shown.size,
          (shown || run) && presetWords((shown || run).preset), day(card.date)].filter(Boolean).join(" · "))),
      h("div", { class: "foot" },
        shown && h("a", { class: "button small", href: `#/run/${key(shown.key)}` }, "Open"),
        h("button", { "aria-label": `Rename ${card.title}`, onclick: () => rename(card, again) }, "Rename"),
        h("button", { class: "danger", "aria-label": `Delete ${card.title}`, onclick: () => remove(card) }, "Delete")));
  }

  function words(card, run, state, judged) {
    if (state === "arriving" && card.coming) {
      return h("p", { class: "small" }, `${plural(card.coming, "file")} on the way, ${bytes(card.here_bytes)} of ${bytes(card.coming_bytes)} here`,
        card.stalled > 0 && h("span", { class: "warn" }, "; stopped in the middle: the sender has left"));
    }
    if (state === "running") {
      const left = run.progress.left_s;
      return [h("div", { class: "line", role: "progressbar", "aria-label": `Run of ${card.title}`, "aria-valuemin": "0", "aria-valuemax": "100",
        "aria-valuenow": Math.round(100 * run.progress.share) }, h("i", { "width%": 100 * run.progress.share })),
        h("p", { class: "small" }, `${Math.round(100 * run.progress.share)} %, ${run.progress.title.toLowerCase()}`,
          left ? `, ${duration(left)} left` : "")];
    }
    if (state === "failed") return h("p", { class: "small bad" }, run.sentence);
    if (state === "waiting") return h("p", { class: "small" }, run.sentence);
    return judged.verdict_sentence ? h("p", { class: "small" }, judged.verdict_sentence) : null;
  }

  const remove = (card) => attempt(async () => {
    const runs = card.kind === "capture" && card.runs.length ? ` Its ${plural(card.runs.length, "run")} stay until deleted, too.` : "";
    if (await dialog(`Delete ${card.title}?`, `It goes into the trash, from where it can be put back.${runs}`, "Delete", { isDanger: true })) {
      await change("delete", { key: card.key });
      again();
    }
  });

  function trash(deleted) {
    if (!deleted.length) return null;
    const total = deleted.reduce((sum, one) => sum + one.bytes, 0);
    return h("details", { class: "panel trash", key: "trash" }, h("summary", {}, `Trash: ${plural(deleted.length, "thing")}, ${bytes(total)}`),
      h("ul", { class: "plain" }, deleted.map((one) => h("li", { key: one.id },
        h("span", { class: "grow" }, one.title, " ", h("span", { class: "quiet small" }, `${bytes(one.bytes)}, ${day(one.when)}`)),
        h("button", { "aria-label": `Put back: ${one.title}`, onclick: () => changed(again)("restore", { id: one.id }) }, "Put back")))),
      h("button", { class: "danger", onclick: () => attempt(async () => {
        if (await dialog("Empty the trash?", `${bytes(total)} are deleted for good.`, "Delete for good", { isDanger: true })) {
          toast(`${bytes(await change("empty_trash"))} freed.`);
          again();
        }
      }) }, "Empty the trash"));
  }
  return view;
}

function matches(card, wanted) {
  return !wanted || [card.title, card.key, ...card.runs.map((run) => run.title)].some((text) => text.toLowerCase().includes(wanted));
}

/** Choose a folder of this machine below the studio's: it is used where it lies, nothing is copied. */
async function choose(ask, again) {
  const box = h("dialog", { "aria-label": "Add a folder", oncancel: () => box.remove() });
  const show = async (place) => {
    const rows = await ask(`/api/folders?key=${key(place)}`);
    box.replaceChildren(h("h2", {}, "Add a folder of this machine"),
      h("p", { class: "quiet" }, "Only folders below the studio's own can be chosen; the photos stay where they are."),
      place ? h("p", {}, h("button", { onclick: () => show(place.split("/").slice(0, -1).join("/")) }, "Up"), ` ${place}`) : null || "",
      h("ul", { class: "plain" }, rows.map((row) => h("li", {},
        h("button", { onclick: () => attempt(() => show(row.key)) }, row.key.split("/").pop()), " ",
        row.is_capture && h("button", { class: "main", onclick: () => attempt(async () => {
          const added = await change("add", { key: row.key });
          box.close(); box.remove();
          location.hash = `#/capture/${key(added)}`;
        }) }, "Use it")))),
      rows.length ? "" : h("p", {}, "No folders here."),
      h("div", { class: "bar" }, h("button", { onclick: () => { box.close(); box.remove(); again(); } }, "Close")));
  };
  await attempt(async () => { await show(""); document.body.append(box); box.showModal(); });
}
