// Phones that are let in: the switch, the code to scan, who is there.

import { h } from "./dom.js";

export function phones(_capture, _again) {
  return { refresh: async () => {}, button: () => null, panel: () => (h, null) };
}
