"""The stage in the studio: the page of a run, its notes that are kept with the run, and who may write them."""

import json
from concurrent.futures import Future

from studio_client import Client, served

from reconstruct.stored_run.stage_document import EMPTY, read_stage_document
from reconstruct.stored_run.stage_pack import STAGE_PACK, StagePack

PAGE, DOCUMENT = "/stage/runs/heap/", "/stage/runs/heap/stage.json"
NOTED = json.dumps(
    EMPTY | {"notes": [{"kind": "arrow", "text": "here", "at": [0, 0, 1], "normal": [0, 0, 1]}]}
).encode()


def test_the_stage_is_behind_the_studios_gate(studio_folder):
    run = studio_folder / "runs" / "heap"
    with served(studio_folder) as (_, _, owner):
        page = owner.raw("GET", PAGE)
        policy = page.headers["Content-Security-Policy"]
        assert page.status == 200 and "script-src 'sha256-" in policy and "frame-ancestors 'self'" in policy
        assert policy.startswith("sandbox allow-scripts") and "allow-same-origin" not in policy
        for path in (
            f"{PAGE}first.jpg",
            f"{PAGE}report.json",
            f"{PAGE}../heap/mesh.ply",
            "/stage/",
            "/stage/runs/none/",
            "/stage/../captures/",
        ):
            assert owner.raw("GET", path).status in (307, 400, 404)
        stranger = Client(owner.port)
        assert stranger.raw("GET", PAGE).status == stranger.raw("PUT", DOCUMENT, NOTED).status == 401
        assert owner.raw("PUT", DOCUMENT, NOTED, Origin="http://evil.example").status == 403
        assert owner.raw("PUT", "/stage/runs/none/stage.json", NOTED).status == 400
        refused = owner.raw("PUT", DOCUMENT, b'{"format": 1, "guess": "gone"}')
        assert refused.status == 400 and "guess" in json.loads(refused.content)["error"]
        assert not (run / "stage.json").exists()
        assert owner.raw("PUT", DOCUMENT, NOTED).status == 200
    found = read_stage_document(run)
    assert found is not None and found["notes"][0]["text"] == "here"
    (run / "stage.json").unlink()


def test_a_damaged_pack_or_one_of_another_solve_counts_as_none(studio_folder, tmp_path):
    run = studio_folder / "runs" / "heap"
    pack, mesh = run / STAGE_PACK, run / "mesh.ply"
    whole, surface = pack.read_bytes(), mesh.read_bytes()
    with served(studio_folder) as (studio, _, _):
        assert isinstance(studio.stage("runs/heap"), StagePack)
        for content in (whole[:-200], whole.replace(b"first.jpg", b"../rs.jpg"), b""):
            pack.write_bytes(content)
            mesh.write_bytes(surface)  # so that the file's time is another
            assert isinstance(studio.stage("runs/heap"), Future)
        pack.write_bytes(whole)
        mesh.write_bytes(surface + b" ")
        assert isinstance(studio.stage("runs/heap"), Future)
        mesh.write_bytes(surface)
