"""The client against a live server."""

from __future__ import annotations

import io
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

import numpy
import pytest

from conftest import READ_KEY, draw_facade
from facades import facade
from live_server import Server
from placeformer import (
    Client,
    Conflict,
    ImageRefused,
    InvalidRequest,
    NewPhoto,
    NotAuthorised,
    NotFound,
    Progress,
)

MOMENT = datetime(2026, 5, 17, 9, 30, tzinfo=timezone.utc)


def test_a_photo_is_stored_found_changed_and_deleted(client: Client, map_name: str) -> None:
    stored = client.add_reference(
        facade(1),
        map_name,
        external_id="drive/1",
        lat=51.5,
        lon=-0.12,
        heading=-90.0,
        captured_at=MOMENT,
        metadata={"camera": "left", "lanes": [1, 2]},
    )
    assert stored.is_new
    assert stored.sources.location == "request"
    assert stored.location is not None
    assert (stored.location.lat, stored.location.heading) == (51.5, 270.0)
    assert stored.metadata == {"camera": "left", "lanes": [1, 2]}
    again = client.add_reference(facade(1), map_name, external_id="drive/1")
    assert (again.id, again.is_new) == (stored.id, False)
    client.add_reference(facade(2), map_name, lat=51.6, lon=-0.12)

    answer = client.query(facade(1), map_name, top_k=1, deadline_ms=100_000)
    assert answer.best is not None
    assert (answer.best.reference_id, answer.best.captured_at) == (stored.id, MOMENT)
    assert answer.best.scores is not None
    inliers = sum(score.inliers for score in answer.best.scores.values())
    assert answer.best.spatial_score == inliers > 0
    assert answer.reranked
    assert answer.timings_ms["extract"] > 0
    near = client.query(facade(1), map_name, near=(51.6, -0.12), radius_m=1000.0, rerank=False)
    assert [one.reference_id == stored.id for one in near.results] == [False]

    changed = client.update_reference(stored.id, heading=None, external_id="drive/one")
    assert changed.location is not None
    assert (changed.location.heading, changed.location.lat) == (None, 51.5)
    assert client.reference(stored.id) == changed
    assert [one.id for one in client.references(map_name, external_id="drive/one")] == [stored.id]
    client.delete_reference(stored.id)
    with pytest.raises(NotFound) as caught:
        client.reference(stored.id)
    assert caught.value.code == "reference_not_found"
    assert len(caught.value.request_id) == 36


def test_arrays_pillow_images_and_files_are_photos(
    client: Client, map_name: str, tmp_path: Path
) -> None:
    picture = draw_facade(3)
    file = tmp_path / "photo.webp"
    picture.save(file, lossless=True)
    client.add_reference(file, map_name, external_id="file")
    for image in (picture, numpy.asarray(picture), file.read_bytes(), str(file)):
        best = client.query(image, map_name).best
        assert best is not None
        assert best.external_id == "file"


def test_a_pair_is_matched_with_its_evidence(client: Client, map_name: str) -> None:
    stored = client.add_reference(facade(4), map_name)
    pair = client.match(facade(4), facade(4), key_patches=True)
    other = client.match(facade(4), reference_id=stored.id)
    assert pair.spatial_score == other.spatial_score > 0
    assert other.key_patches is None
    assert pair.key_patches is not None
    centres = {patch.centre for patch in pair.key_patches.query if patch.scale == 1}
    combination = pair.combinations["s11"]
    assert len(combination.correspondences) == combination.matches > 0
    for correspondence in combination.correspondences:
        assert correspondence.query in centres
        assert 0 < correspondence.query.x < pair.input_size.width
    assert combination.homography is not None
    with pytest.raises(ValueError, match="either"):
        client.match(facade(4))


def test_listings_follow_the_cursor(client: Client, map_name: str) -> None:
    names = [f"{seed}" for seed in range(5)]
    for seed, name in enumerate(names):
        client.add_reference(facade(seed), map_name, external_id=name)
    listed = [one.external_id for one in client.references(map_name, page_size=2)]
    assert listed == names


def test_maps_are_listed_shown_calibrated_and_deleted(client: Client, map_name: str) -> None:
    client.add_reference(facade(1), map_name)
    assert map_name in [one.name for one in client.maps()]
    calibration = client.info().calibration
    assert calibration is not None
    assert client.set_calibration(map_name, calibration) == calibration
    assert client.map(map_name).calibration == calibration
    client.remove_calibration(map_name)
    shown = client.map(map_name)
    assert (shown.calibration, shown.references) == (None, 1)
    assert client.delete_map(map_name).references_deleted == 1
    with pytest.raises(NotFound, match="map_not_found"):
        client.map(map_name)


def test_a_head_is_read_from_its_file(client: Client, map_name: str, tmp_path: Path) -> None:
    client.add_reference(facade(1), map_name)
    head = tmp_path / "head.safetensors"
    head.write_bytes(b"no head")
    with pytest.raises(InvalidRequest, match="head_unreadable"):
        client.set_head(map_name, head)
    assert client.remove_head(map_name).name == map_name


def test_refusals_are_exceptions_of_their_kind(client: Client, map_name: str) -> None:
    client.add_reference(facade(1), map_name, external_id="taken")
    with pytest.raises(Conflict) as conflict:
        client.add_reference(facade(2), map_name, external_id="taken")
    assert conflict.value.code == "external_id_conflict"
    with pytest.raises(ImageRefused, match="image_undecodable"):
        client.query(facade(1)[:1000], map_name)
    with pytest.raises(InvalidRequest, match="lat and lon belong together"):
        client.add_reference(facade(3), map_name, lat=1.0)
    with pytest.raises(InvalidRequest, match="top_k"):
        client.query(facade(1), map_name, top_k=100_000)
    with pytest.raises(ValueError, match="captured_after has no offset"):
        client.query(facade(1), map_name, captured_after=datetime(2026, 1, 1))


def test_readiness_is_an_answer(client: Client) -> None:
    assert client.readiness().is_ready
    assert client.info().limits.top_k >= 1


def test_a_key_opens_what_its_role_allows(locked_server: Server, map_name: str) -> None:
    for key in (None, "another key"):
        with Client(locked_server.url, api_key=key) as client, pytest.raises(NotAuthorised) as no:
            client.maps()
        assert no.value.code == "unauthorized"
    with Client(locked_server.url, api_key=READ_KEY) as client:
        assert client.maps() == []
        with pytest.raises(NotAuthorised) as no:
            client.add_reference(facade(1), map_name)
        assert no.value.code == "forbidden"
        photos = [NewPhoto(facade(seed)) for seed in range(3)]
        with pytest.raises(NotAuthorised):
            list(client.ingest(photos, map_name))


def test_an_ingest_gives_a_verdict_for_each_photo_in_order(
    client: Client, map_name: str, tmp_path: Path
) -> None:
    client.add_reference(facade(1), map_name, external_id="1")
    broken = facade(9)[:500]
    photos = [
        NewPhoto(facade(0), {"external_id": "0", "lat": 1.0, "lon": 2.0}),
        NewPhoto(facade(1), {"external_id": "1"}),
        NewPhoto(broken, {"external_id": "2"}),
        NewPhoto(tmp_path / "nowhere.jpg", {"external_id": "3"}),
        NewPhoto(io.BytesIO(facade(4)).getvalue(), {"external_id": "4"}),
    ]
    seen: list[Progress] = []
    verdicts = list(client.ingest(photos, map_name, workers=2, progress=seen.append))
    assert [verdict.photo for verdict in verdicts] == photos
    outcomes = [verdict.outcome for verdict in verdicts]
    assert outcomes == ["added", "present", "refused", "refused", "added"]
    assert isinstance(verdicts[2].error, ImageRefused)
    assert isinstance(verdicts[3].error, FileNotFoundError)
    assert [progress.done for progress in seen] == [1, 2, 3, 4, 5]
    last = seen[-1]
    assert (last.total, last.added, last.present, last.refused) == (5, 2, 1, 2)
    assert last.photos_per_second > 0
    assert client.map(map_name).references == 3


def test_an_ingest_takes_photos_as_they_are_made_and_can_be_left(
    client: Client, map_name: str
) -> None:
    made: list[int] = []

    def photos() -> Iterator[NewPhoto]:
        for seed in range(100):
            made.append(seed)
            yield NewPhoto(facade(seed), {"external_id": str(seed)})

    verdicts = client.ingest(photos(), map_name, workers=2)
    assert next(verdicts).outcome == "added"
    verdicts.close()
    assert len(made) <= 5
    assert 1 <= client.map(map_name).references <= 5
