// The runs that wait for this machine: which one is at work, what each takes, and when all are done.

import { about, attempt, bytes, change, duration, h, key, presetWords } from "./dom.js";

/** The seconds that jobs take together; null where that is not known. */
export const leftOf = (jobs) => (jobs.some((job) => job.left_s === null || job.left_s === undefined) ? null : jobs.reduce((sum, job) => sum + job.left_s, 0));

/** `jobs`: in the order in which they run; `again` draws the page anew. */
export function queue(jobs, again) {
  if (!jobs.length) return null;
  const left = leftOf(jobs), told = left === null ? "how long they take is not known yet" : `all done in ${about(left)}`;
  const act = (job, action) => attempt(async () => { await change("queue", { job: job.id, action }); again(); });
  return h("section", { class: "panel queue", key: "queue" }, h("h2", {}, "At work"),
    h("p", { class: "quiet" }, `One run at a time, ${jobs.length} in the queue; ${told}.`),
    h("ol", { class: "plain" }, jobs.map((job, place) => h("li", { key: job.id },
      h("a", { href: `#/run/${key(job.run)}` }, `${job.title}, ${presetWords(job.preset).toLowerCase()}`), ` ${cost(job)} `,
      job.state === "waiting" && place > 1 && h("button", { "aria-label": `Next in line: ${job.title}`, onclick: () => act(job, "first") }, "Next in line"), " ",
      stop(job)))));

  function stop(job) {
    const words = job.state === "running" ? "Stop and keep" : "Take out";
    return h("button", { "aria-label": `${words}: ${job.title}`, onclick: () => act(job, "stop") }, words);
  }
}

function cost(job) {
  const memory = job.bytes ? `, ${bytes(job.bytes)} of memory` : "";
  if (job.state === "running") return job.left_s === null || job.left_s === undefined ? "has just begun" : `${duration(job.left_s)} left${memory}`;
  return job.left_s ? `waits, ${about(job.left_s)}${memory}` : "waits";
}
