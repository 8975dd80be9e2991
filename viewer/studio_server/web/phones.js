// Phones that are let in: the switch, the code to scan, who is there.

import { ask, attempt, change, duration, h, key } from "./dom.js";

const ROLES = { camera: " photographs", light: " holds the light" };

export function phones(capture, again) {
  let row = { on: false, phones: [] }, isLive = false;
  const turn = (name, values) => attempt(async () => { await change(name, values); await refresh(); again(); });
  const refresh = async () => { row = await ask("/api/phones"); };

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
            h("p", {}, "The phone must be in the same network. Each code lets one phone in; the next one shows at once. Photos travel unencrypted in your network."),
            h("p", { class: "small" }, "Or open ", h("code", {}, address)),
            h("label", {}, h("input", { type: "checkbox", checked: isLive, onchange: (event) => { isLive = event.target.checked; again(); } }),
              " Live camera (https). The phone warns, because this machine signs for itself: choose Advanced, then Proceed."),
            row.phones.length === 0 && h("p", {}, "No phone yet."),
            row.phones.length > 0 && h("ul", { class: "plain" }, row.phones.map((one, k) => h("li", {}, `Phone ${k + 1} (${one.name})${ROLES[one.role] || ""}${one.is_here ? "" : ", not connected: it goes on sending when it is back"}`))),
            row.phones.some((one) => one.role === "camera") && h("button", { class: "main", onclick: () => turn("shoot", {}) }, "Take a photo"),
            h("p", { class: "small quiet" }, `Closes by itself in ${duration(row.left_s)}.`))));
    },
  };
}
