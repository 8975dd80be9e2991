"""The stage: a finished run as a picture that is lit from where the pointer is, and turned in the hand.

Comes in: the folder of a finished run.
Goes out: a page in one file, to send (`page_of`), and the same beside viser's page (viewer/page).

One idea: what the browser draws is always the same mesh with the same materials, light and shadow. The first view is
the photo's: each pixel takes its albedo from the photo's own pixel, by projection, so that the page opens as a relit
photograph. As the view turns, what the photo does not show takes the colour of the mesh's vertices. Surface and
material go to a G-buffer when the view changes, depth seen from the lamp to a shadow map when the lamp moves, and one
full-screen pass lights them; what comes from sky and ground was computed before (reconstruct/render/soft_light.py).
While a hand moves something the picture has fewer pixels; at rest samples of pixel and lamp are averaged.

What cannot be read from the photos is said: where the surface is a guess it can be marked or cut away.
Notes, saved views, crop and the like are one document, `stage.json` (reconstruct/stored_run/stage_document.py).
"""
