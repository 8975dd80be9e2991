// The coach's voice: says once what is wrong with the newest photo and what to do next, and shakes a phone for what is wrong.

import { h } from "./dom.js";

const SHAKE_MS = [200, 100, 200];

/** `again` draws the page anew. */
export function voice(again) {
  const told = new Set();
  let isLoud = false, said = "";

  /** `bad`: [{name, remarks}], photos that will not be used, oldest first; `advice`: what to do next. */
  function hear(bad, advice) {
    const fresh = bad.filter((one) => !told.has(one.name));
    if (fresh.length && navigator.vibrate && navigator.userActivation?.hasBeenActive) navigator.vibrate(SHAKE_MS); // browsers refuse it before a touch
    fresh.forEach((one) => told.add(one.name));
    const wrong = bad.slice(-1).map((one) => `${one.name.split("/").pop()}: ${one.remarks[0][0]}. It will not be used.`);
    const words = [...wrong, advice].filter(Boolean).join(" ");
    if (!isLoud || !words || words === said) return;
    said = words;
    speechSynthesis.cancel();
    speechSynthesis.speak(new SpeechSynthesisUtterance(words));
  }

  const control = () => "speechSynthesis" in window && h("label", { class: "small" },
    h("input", { type: "checkbox", checked: isLoud, onchange: (event) => {
      [isLoud, said] = [event.target.checked, ""];
      if (!isLoud) speechSynthesis.cancel();
      again();
    } }), " Say aloud what to do next");
  return { hear, control };
}
