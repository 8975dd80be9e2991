// The board: print it, or show it at true scale on a screen.

import { ask, attempt, h, key } from "./dom.js";

const GAUGE_MM = 85.6; // a bank card's long side (ISO/IEC 7810 ID-1)

/** Show the board on this screen at true scale, after a bank card was held against it. */
export function boardOnScreen(spec) {
  return attempt(async () => {
    const board = await ask(`/api/board_shapes?board=${key(spec)}`);
    let scale = Number(localStorage.getItem("px-per-mm")) || 96 / 25.4;
    const box = h("dialog", { class: "full", "aria-label": "Board on this screen" });
    const card = h("div", { class: "gauge" });
    const canvas = h("canvas", { role: "img", "aria-label": `Board ${board.spec}` });
    const told = h("p", { class: "bad", role: "status" });
    const range = h("input", { type: "range", min: "2", max: "16", step: "0.005", value: scale, "aria-label": "Size on the screen" });
    const draw = () => {
      card.style.cssText = `width:${GAUGE_MM * scale}px;height:${53.98 * scale}px;border:2px solid #b00;border-radius:${3.2 * scale}px;margin:1rem 0`;
      const dense = scale * (window.devicePixelRatio || 1);
      canvas.width = Math.round(board.width * dense);
      canvas.height = Math.round(board.height * dense);
      canvas.style.cssText = `width:${board.width * scale}px;height:${board.height * scale}px;display:block`;
      const isLarger = board.width * scale > innerWidth || board.height * scale > innerHeight;
      told.textContent = isLarger ? `The board is larger than this window (${Math.round(board.width)} × ${Math.round(board.height)} mm). Show the window in full, or take a larger screen.` : "";
      const pen = canvas.getContext("2d");
      pen.fillStyle = "#fff";
      pen.fillRect(0, 0, canvas.width, canvas.height);
      for (const [x, y, w, height, isBlack] of board.shapes) {
        pen.fillStyle = isBlack ? "#000" : "#fff";
        const [left, top] = [Math.round(x * dense), Math.round(y * dense)];
        pen.fillRect(left, top, Math.round((x + w) * dense) - left, Math.round((y + height) * dense) - top);
      }
    };
    const close = () => { removeEventListener("resize", draw); box.close(); box.remove(); };
    const alone = (is) => { words.hidden = is; back.hidden = !is; (is ? back : only).focus(); box.scrollTop = 0; };
    const only = h("button", { class: "main", onclick: () => alone(true) }, "Show the board alone");
    const back = h("button", { onclick: () => alone(false), hidden: true }, "Back");
    range.oninput = () => { scale = Number(range.value); localStorage.setItem("px-per-mm", scale); draw(); };
    const words = h("div", {},
      h("h2", {}, "1. Make the red frame as large as a bank card"), h("p", {}, "Hold a card against the screen, and move the slider until both are the same."),
      range, card, h("h2", {}, "2. Check the ruler, and photograph the board"),
      h("p", {}, "The ruler below the squares must be 100 mm long. Turn the brightness up, lay the screen flat where the object will stand, and ",
        "leave it there under the object, or put a sheet of the screen's thickness in its place: its surface counts as the table."),
      told, h("div", { class: "bar" }, only, h("button", { onclick: close }, "Close")));
    box.append(words, canvas, back);
    box.oncancel = close;
    addEventListener("resize", draw);
    document.body.append(box);
    draw();
    box.showModal();
  });
}

export function printLink(spec, paper, words) {
  return h("a", { class: "button", href: `/board.pdf?board=${key(spec)}&paper=${paper}`, target: "_blank", rel: "noopener" }, words);
}
