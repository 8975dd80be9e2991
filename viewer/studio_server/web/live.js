// The live camera of a phone: exposure and focus locked, a photo at the press of a button, on the desktop's word, or by
// itself once the light has moved and stands still. A second phone holds the light: its torch is on.

import { attempt, change, h } from "./dom.js";
import { dome } from "./hemisphere.js";
import { sending } from "./upload.js";
import { voice } from "./voice.js";

const GRID = [48, 36], LOOK_MS = 200, MOVED = 0.06, STILL = 0.012, STILL_LOOKS = 4;

/** The view of one phone; `phone` is what all views share: its state, its sender, and how to draw again. */
export function live(phone) {
  const loud = voice(phone.draw);
  let role = "", shows = "board", track = null, video = null, locked = [], isAuto = false, isTorchOn = false;
  let before = null, atShot = null, still = 0, shots = 0, taken = 0;

  async function open(kind) {
    role = kind;
    if (!navigator.mediaDevices) throw new Error("The browser gives no camera here; live mode needs the https address.");
    const wanted = { facingMode: "environment", width: { ideal: 4096 }, height: { ideal: 3072 } };
    const stream = await navigator.mediaDevices.getUserMedia({ video: wanted, audio: false });
    [track] = stream.getVideoTracks();
    video = h("video", { autoplay: true, muted: true, playsinline: true, class: "picture", "aria-label": "What the camera sees" });
    video.muted = true;
    video.srcObject = stream;
    video.stays = true;
    video.key = "video";
    await video.play();
    track.onended = () => { phone.problem = "The camera was taken away. Open it again."; track = null; phone.draw(); };
    await change("role", { role: kind });
    shots = phone.state ? phone.state.shots : 0;
    if (kind === "light") await light();
    else setTimeout(lockAll, 1500); // once the camera has settled
  }

  /** Turn the torch on; a browser that cannot ignores the wish, and says nothing. */
  async function light() {
    const can = track.getCapabilities ? track.getCapabilities() : {};
    isTorchOn = Boolean(can.torch) && await lock({ torch: true });
    phone.draw();
  }

  /** Lock what the camera can lock, at what it has chosen now. */
  async function lockAll() {
    const can = track && track.getCapabilities ? track.getCapabilities() : {}, now = track ? track.getSettings() : {};
    locked = [];
    for (const [mode, value] of [["exposureMode", "exposureTime"], ["focusMode", "focusDistance"], ["whiteBalanceMode", "colorTemperature"]]) {
      if ((can[mode] || []).includes("manual")) {
        const values = { [mode]: "manual", ...(now[value] === undefined ? {} : { [value]: now[value] }) };
        if (await lock(values)) locked.push(mode.replace("Mode", "").replace("whiteBalance", "white balance"));
      }
    }
    phone.draw();
  }

  async function lock(values) {
    try { await track.applyConstraints({ advanced: [values] }); return true; } catch { return false; }
  }

  async function shoot() {
    if (!video || !video.videoWidth) return;
    const canvas = h("canvas", { width: video.videoWidth, height: video.videoHeight });
    canvas.getContext("2d").drawImage(video, 0, 0);
    const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png")); // JPEG changes dark blue by .3 levels
    taken += 1;
    const name = `live-${role}-${new Date().toISOString().replace(/[^0-9]/g, "").slice(0, 17)}-${String(taken).padStart(3, "0")}.png`;
    phone.sender.add([{ file: new File([blob], name, { lastModified: Date.now() }), path: name }], role === "light" ? "light" : shows);
    atShot = before;
    if (navigator.vibrate) navigator.vibrate(40);
  }

  /** The picture as a few numbers, to see whether the light has moved. */
  function look() {
    if (!video || !video.videoWidth || role !== "camera") return;
    const canvas = look.canvas || (look.canvas = h("canvas", { width: GRID[0], height: GRID[1] }));
    const pen = canvas.getContext("2d", { willReadFrequently: true });
    pen.drawImage(video, 0, 0, ...GRID);
    const data = pen.getImageData(0, 0, ...GRID).data;
    const now = Float32Array.from({ length: GRID[0] * GRID[1] }, (_, k) => (data[4 * k] + data[4 * k + 1] + data[4 * k + 2]) / 765);
    still = before && distance(before, now) < STILL ? still + 1 : 0;
    before = now;
    if (isAuto && still === STILL_LOOKS && (!atShot || distance(atShot, now) > MOVED)) shoot();
  }

  function distance(one, other) {
    let sum = 0, level = 1e-3;
    for (let k = 0; k < one.length; k += 1) { sum += Math.abs(one[k] - other[k]); level += Math.max(one[k], other[k]); }
    return sum / level;
  }

  function page({ state, problem }) {
    const start = (kind) => () => attempt(async () => { await open(kind); phone.draw(); });
    if (!track) {
      return [h("h1", {}, state.title), problem && h("p", { class: "bad" }, problem),
        h("section", { class: "panel" }, h("h2", {}, "What does this phone do?"),
          h("div", { class: "bar" }, h("button", { class: "main", onclick: start("camera") }, "It photographs"), h("button", { onclick: start("light") }, "It holds the light")),
          h("p", { class: "small quiet" }, "The one that photographs stands on a tripod. The one that holds the light turns its torch on, and photographs the board with each shot."))].filter(Boolean);
    }
    return [h("h1", {}, state.title), problem && h("p", { class: "bad" }, problem), video,
      role === "camera" && h("fieldset", { class: "choice", "aria-label": "What is photographed" }, [["board", "The board, room light on"], ["lit", "The object, flashlight only"], ["side", "From the side"]]
        .map(([value, words]) => h("label", { key: value }, h("input", { type: "radio", name: "shows", value, checked: value === shows, onchange: () => { shows = value; phone.draw(); } }), words))),
      h("div", { class: "bar" }, h("button", { class: "main", onclick: shoot }, "Take a photo"),
        role === "camera" && h("button", { onclick: lockAll }, "Lock exposure now"),
        role === "camera" && h("label", {}, h("input", { type: "checkbox", checked: isAuto, onchange: (event) => { isAuto = event.target.checked; atShot = before; } }), " By itself, when the light has moved and stands still")),
      role === "camera" && h("p", { class: "small quiet" }, locked.length ? `Locked: ${locked.join(", ")}.` : "This browser locks nothing: hold still, and keep the room as dark as it was. The camera app with uploads is better."),
      role === "light" && h("p", { class: isTorchOn ? "quiet" : "warn" }, isTorchOn ? "The torch is on. Hold the phone so that its camera sees the board, in another place for each shot."
        : "This browser cannot turn the torch on while its camera is open. Hold a flashlight against the phone, beside its camera, or let another phone hold the light."),
      sending(phone.sender), h("p", {}, `${state.counts.words}${state.bad.length ? `; take again: ${state.bad.map((one) => one.name).slice(-3).join(", ")}` : ""}.`),
      role === "camera" && loud.control(),
      role === "camera" && state.coach.advice && h("p", { class: "verdict", "aria-live": "polite" }, state.coach.advice),
      role === "camera" && state.coach.lights.length > 0 && dome(state.coach.lights.map((light) => ({ ...light, used: true })))].filter(Boolean);
  }

  const heard = (state) => {
    if (track && state.shots > shots) shoot();
    shots = state.shots;
    if (role === "camera") loud.hear(state.bad, state.coach.advice);
  };
  setInterval(look, LOOK_MS);
  return { title: "Live camera for Shadowgraph", pause: () => 700, page, heard };
}
