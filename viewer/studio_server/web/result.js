// Runs: those that wait for this machine, the progress of one, its result once it is finished.

import { about, ask, attempt, bytes, change, changed, dialog, duration, h, key, plural, presetWords, rename } from "./dom.js";
import { saving } from "./save.js";

/** The seconds that jobs take together; null where that is not known. */
const leftOf = (jobs) => (jobs.some((job) => job.left_s === null || job.left_s === undefined) ? null : jobs.reduce((sum, job) => sum + job.left_s, 0));

/** `jobs`: in the order in which they run; `again` draws the page anew. */
export function queue(jobs, again) {
  if (!jobs.length) return null;
  const left = leftOf(jobs), told = left === null ? "how long they take is not known yet" : `all done in ${about(left)}`;
  const act = (job, action) => changed(again)("queue", { job: job.id, action });
  return h("section", { class: "panel queue", key: "queue" }, h("h2", {}, "At work"),
    h("p", { class: "quiet" }, `One run at a time, ${jobs.length} in the queue; ${told}.`),
    h("ol", { class: "plain" }, jobs.map((job, place) => h("li", { key: job.id },
      h("a", { href: `#/run/${key(job.run)}` }, `${job.title}, ${presetWords(job.preset).toLowerCase()}`), ` ${cost(job)} `,
      job.state === "waiting" && place > 1 && h("button", { "aria-label": `Next in line: ${job.title}`, onclick: () => act(job, "first") }, "Next in line"), " ",
      stop(job)))));

  function stop(job) {
    const words = job.state === "running" ? "Stop and keep" : "Remove";
    return h("button", { "aria-label": `${words}: ${job.title}`, onclick: () => act(job, "stop") }, words);
  }
}

function cost(job) {
  const memory = job.bytes ? `, ${bytes(job.bytes)} of memory` : "";
  if (job.state === "running") return job.left_s === null || job.left_s === undefined ? "has just begun" : `${duration(job.left_s)} left${memory}`;
  return job.left_s ? `waits, ${about(job.left_s)}${memory}` : "waits";
}

export function run(name, again) {
  const view = { pause: 1000, wide: true };
  const saver = saving(name, again);

  view.render = async (ask) => {
    const state = await ask("/api/state");
    const found = state.cards.flatMap((card) => card.runs.map((one) => ({ card, one }))).find(({ one }) => one.key === name);
    if (!found) throw new Error(state.cards.some((card) => card.key === name)
      ? "This is a capture; a run was needed. Open it from all captures, and start a run there." : "This run is not here any more: it was moved or deleted.");
    const { card, one } = found;
    document.title = `${one.title} · Shadowgraph studio`;
    view.pause = one.state === "running" || one.state === "waiting" ? 1000 : 4000;
    return [
      h("h1", {}, one.title),
      one.state === "finished" ? result(one) : progress(one, before(state.queue, one), card.kind === "capture" ? `#/capture/${key(card.key)}` : ""),
      h("div", { class: "bar", key: "about" }, card.kind === "capture" && h("a", { class: "button", href: `#/capture/${key(card.key)}` }, "Its photos"),
        h("button", { onclick: () => rename(one, again) }, "Rename"),
        h("button", { class: "danger", disabled: one.state === "running" || one.state === "waiting", onclick: () => remove(one) }, "Delete"),
        h("a", { class: "button", href: "#/" }, "All captures")),
    ];
  };

  /** How long the runs before this one take, in words; "" where that is not known. */
  function before(queued, one) {
    const place = queued.findIndex((job) => job.run === one.key), left = place > 0 ? leftOf(queued.slice(0, place)) : null;
    return left === null ? "" : ` It begins in ${about(left)}.`;
  }

  function progress(one, begins, photos) {
    const now = one.progress, percent = Math.round(100 * now.share);
    return h("section", { class: "panel" },
      h("h2", {}, one.state === "running" ? now.title : one.state === "waiting" ? "In the queue" : one.state === "failed" ? "It failed" : "Stopped"),
      one.state === "running" && h("div", { class: "line", role: "progressbar", "aria-label": "Whole run", "aria-valuemin": "0", "aria-valuemax": "100",
        "aria-valuenow": percent }, h("i", { "width%": percent })),
      one.state === "running" && h("p", {}, `${percent} %, `, h("span", { id: "clock" }, duration(now.elapsed_s)), " so far",
        now.left_s ? `, about ${duration(now.left_s)} left` : ""),
      now.message && one.state === "running" && h("p", { class: "quiet" }, now.message),
      one.sentence && (one.state === "failed" ? h("p", { class: "verdict bad" }, one.sentence) : h("p", {}, one.sentence, one.state === "waiting" && begins)),
      one.state === "running" && h("p", { class: "quiet" }, "It goes on when this page or the studio is closed."),
      h("div", { class: "bar" },
        (one.state === "running" || one.state === "waiting") && one.job && h("button", { onclick: () => act(one, "stop") }, one.state === "running" ? "Stop and keep" : "Remove from the queue"),
        one.state === "running" && h("button", { onclick: () => inspect(one) }, "Watch it grow in 3D"),
        one.state === "waiting" && h("button", { onclick: () => act(one, "first") }, "Next in line"),
        one.state === "failed" && photos && h("a", { class: "button main", href: photos }, "Look at its photos"),
        (one.state === "failed" || one.state === "stopped") && one.job && h("button", { class: one.state === "stopped" ? "main" : "", onclick: () => act(one, "again") }, "Go on where it stood")));
  }

  function result(one) {
    return h("div", {},
      one.has_mesh ? stage(one) : h("p", { class: "bad" }, "This run has no result that could be shown: its mesh is missing. Start it again."),
      h("div", { class: "bar" }, one.has_mesh && h("button", { onclick: fill }, "Fill the window"),
        one.has_report && h("a", { class: "button", href: `/report?key=${key(one.key)}`, target: "_blank", rel: "noopener" }, "Report")),
      facts(one),
      one.scale && h("p", { class: "quiet" }, one.scale),
      one.verdict_sentence && h("p", { class: `verdict ${one.verdict}` }, one.verdict_sentence),
      one.warnings.length > 0 && h("details", { class: "panel" }, h("summary", { class: "warn" }, plural(one.warnings.length, "remark")),
        h("ul", { class: "plain" }, one.warnings.map((text) => h("li", {}, text)))),
      one.has_mesh && saver.panel());
  }

  const fill = () => attempt(() => document.querySelector("iframe.result").requestFullscreen());
  const act = (one, action) => changed(again)("queue", { job: one.job, action });
  const remove = (one) => attempt(async () => {
    if (await dialog(`Delete ${one.title}?`, "It goes into the trash, from where it can be put back.", "Delete", { isDanger: true })) {
      await change("delete", { key: one.key });
      location.hash = "#/";
    }
  });
  const inspect = (one) => attempt(async () => {
    const tab = window.open("", "_blank");
    const address = await change("view", { key: one.key }).catch((error) => { tab?.close(); throw error; });
    if (tab) { tab.opener = null; tab.location = address; } else location.href = address;
  });

  view.close = saver.close;
  return view;
}

const facts = (one) => h("ul", { class: "facts" }, [one.size, one.preset && presetWords(one.preset), `made in ${duration(one.progress.elapsed_s)}`,
  one.guessed !== null && `${Math.round(100 * one.guessed)} % of the surface is a guess, which no photo shows and no shadow holds`].filter(Boolean).map((text) => h("li", {}, text)));

const stageOf = (one) => `/stage/${one.key.split("/").map(key).join("/")}/`;

const stage = (one) => frame(stageOf(one), `${one.title}, to relight and turn`, one.date);

/** A stage, without an origin, because it may be a stranger's; one that its run has not packed is packed at the first look. */
export function frame(address, title, date = "") {
  const element = h("iframe", { class: "result", title, key: `${address} ${date}`, sandbox: "allow-scripts allow-downloads allow-forms" });
  element.address = address;
  element.stays = true;
  const later = (pause) => setTimeout(() => attempt(wait), pause);
  const wait = async () => {
    if (!element.isConnected) return; // the page keeps the one that it has
    const response = await fetch(address, { method: "HEAD", credentials: "same-origin" });
    if (response.status === 202) later(800);
    else if (response.ok) element.src = address;
    else await ask(address).catch((error) => element.replaceWith(h("p", { class: "bad" }, error.message)));
  };
  later(0);
  return element;
}

/** A result has no origin, so it can ask nothing of the studio: its notes are kept with its run by this page. */
addEventListener("message", async ({ source, data }) => {
  const element = [...document.querySelectorAll("iframe.result")].find((one) => one.contentWindow === source);
  if (!element || typeof data.keep !== "string") return;
  let kept = "";
  try {
    const answer = await fetch(`${element.address}stage.json`, { method: "PUT", body: data.keep, credentials: "same-origin" });
    if (!answer.ok) kept = (await answer.json().catch(() => ({}))).error || `the studio answered ${answer.status}`;
  } catch { kept = "the studio does not answer"; }
  source.postMessage({ kept }, "*");
});
