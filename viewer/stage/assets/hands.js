// Pointers and keys. The mouse lights by moving, turns by dragging; one finger lights, two turn and zoom.
import { byId } from "./scene.js";
import { goHome, lampFromAbove, putLamp, redo, setShown, setView, shown, turnView, undo, view, zoomView, LOOKS } from "./state.js";
import { endTool, moveCross, placeAt, tool } from "./notes.js";
import { listKeys } from "./panel.js";

const TURN_PER_PX = 0.007, TURN_PER_KEY = 0.1, LIGHT_PER_KEY = 0.06, ZOOM_PER_NOTCH = 1.12, CROSS_PER_KEY = 8, SHIFT_PER_KEY = 0.04;
const REACH = 0.48;                   // of the window's shorter side: there the lamp is at the horizon
const CLICK_PX = 5;
const fingers = new Map();
let pressedAt = null, middleOf = () => [innerWidth / 2, innerHeight / 2], moved = () => {};

const lightFrom = (x, y) => {
  const [mx, my] = middleOf(), reach = REACH * Math.min(innerWidth, innerHeight);
  putLamp((x - mx) / reach, (my - y) / reach);
};
const inSides = (x, y) => { const side = Math.min(innerWidth, innerHeight); return [(x - innerWidth / 2) / side, (y - innerHeight / 2) / side]; };

export function useHands(middle, whenMoved) {
  middleOf = middle;
  moved = whenMoved;
  const canvas = byId("picture");
  canvas.addEventListener("pointerdown", down);
  canvas.addEventListener("pointermove", move);
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, up);
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); moved(e.timeStamp); zoomView(e.deltaY > 0 ? 1 / ZOOM_PER_NOTCH : ZOOM_PER_NOTCH, inSides(e.clientX, e.clientY)); }, { passive: false });
  canvas.addEventListener("dblclick", () => { if (!tool.kind) goHome(); });
  window.addEventListener("keydown", key);
}

function down(e) {
  fingers.set(e.pointerId, [e.clientX, e.clientY]);
  pressedAt = fingers.size === 1 ? [e.clientX, e.clientY] : null;
  e.target.setPointerCapture(e.pointerId);
}

function up(e) {
  fingers.delete(e.pointerId);
  if (e.type === "pointerup" && tool.kind && pressedAt && Math.hypot(e.clientX - pressedAt[0], e.clientY - pressedAt[1]) < CLICK_PX) placeAt(e.clientX, e.clientY);
}

function move(e) {
  const was = fingers.get(e.pointerId), now = [e.clientX, e.clientY];
  moved(e.timeStamp);
  if (!was) {
    if (e.pointerType === "mouse" && shown.follows && !tool.kind) lightFrom(...now);
    return;
  }
  const others = [...fingers].filter(([id]) => id !== e.pointerId).map(([, p]) => p);
  fingers.set(e.pointerId, now);
  const dx = now[0] - was[0], dy = now[1] - was[1];
  if (others.length) {
    const gap = (p) => Math.max(1, Math.hypot(p[0] - others[0][0], p[1] - others[0][1]));
    zoomView(gap(now) / gap(was), inSides((now[0] + others[0][0]) / 2, (now[1] + others[0][1]) / 2));
    turnView(TURN_PER_PX * dx / 2, TURN_PER_PX * dy / 2);
  } else if (e.buttons & 2 || e.ctrlKey || e.metaKey) {
    const side = Math.min(innerWidth, innerHeight);
    setView({ shift: [view.shift[0] + dx / side, view.shift[1] + dy / side] });
  } else if (e.pointerType === "mouse" ? !e.shiftKey : shown.drags === "view") turnView(TURN_PER_PX * dx, TURN_PER_PX * dy);
  else lightFrom(...now);
}

// Keys that an element needs for itself, when it has the focus.
function isItsOwn({ target, key }) {
  if (target.closest("dialog, select, textarea, input[type=number], input[type=text]")) return true;
  return target.matches("input[type=range]") ? /^(Arrow|Home|End|Page)/.test(key) : key === "Enter" && target.matches("button, summary, a, input");
}

function key(e) {
  if (isItsOwn(e)) return;
  const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  if (step) {
    e.preventDefault();
    moved(e.timeStamp);
    if (tool.kind) moveCross(CROSS_PER_KEY * step[0], CROSS_PER_KEY * step[1]);
    else if (e.ctrlKey || e.metaKey) setView({ shift: [view.shift[0] + SHIFT_PER_KEY * step[0], view.shift[1] + SHIFT_PER_KEY * step[1]] });
    else if (e.shiftKey !== (shown.drags === "view")) turnView(-TURN_PER_KEY * step[0], -TURN_PER_KEY * step[1]);
    else { const [u, v] = lampFromAbove(); putLamp(u + LIGHT_PER_KEY * step[0], v - LIGHT_PER_KEY * step[1]); }
  } else if (e.key === "Enter" && tool.kind) { e.preventDefault(); placeAt(...tool.cross); }
  else if (e.key === "Escape" && tool.kind) endTool();
  else if (e.key === "+" || e.key === "=") zoomView(ZOOM_PER_NOTCH);
  else if (e.key === "-") zoomView(1 / ZOOM_PER_NOTCH);
  else if (e.key === "?") listKeys();
  else if (e.key === "Home" || e.key === "0") goHome();
  else if (e.key === "l" || e.key === "L") setShown({ follows: !shown.follows });
  else if (e.key >= "1" && e.key <= String(LOOKS.length)) setShown({ look: LOOKS[Number(e.key) - 1] });
  else if ((e.ctrlKey || e.metaKey) && e.key.toLowerCase() === "z") { e.preventDefault(); if (e.shiftKey) redo(); else undo(); }
}
