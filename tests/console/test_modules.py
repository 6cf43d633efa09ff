"""The page's own computations, in the browser that runs them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page

from live_server import Server

OpenPage = Callable[..., Page]
Evaluate = Callable[[str, str, Any], Any]


@pytest.fixture
def evaluate(server: Server, open_page: OpenPage) -> Evaluate:
    """Calls a function of JavaScript with a module of the page and an argument."""
    page = open_page(server)

    def evaluate(module: str, function: str, argument: Any = None) -> Any:
        call = f"async (given) => ({function})(await import('/console/js/{module}.js'), given)"
        return page.evaluate(call, argument)

    return evaluate


def test_coverage(evaluate: Evaluate) -> None:
    def of(points: list[tuple[float, float, float | None]]) -> Any:
        return evaluate(
            "coverage",
            """(module, given) => module.coverageOf(
              given.map(([x, y, heading]) => ({at: [x, y], heading})))""",
            points,
        )

    empty = of([])
    assert (empty["stretches"], empty["gaps"], empty["oneWay"]) == (0, [], [])
    # Three stretches in a row, and one that is too far away to belong to them.
    row = [(0.0, 0.0, None), (24.0, 0.0, None), (84.0, 0.0, None), (234.0, 0.0, None)]
    found = of([*row, (5000.0, 0.0, None)])
    assert found["stretches"] == 4
    gaps = [(gap["from"], gap["to"], gap["length"]) for gap in found["gaps"]]
    assert gaps == [(2, 3, 150), (1, 2, 60)]
    # A ring of stretches is connected once, not twice.
    ring = [(0.0, 0.0, None), (100.0, 0.0, None), (50.0, 80.0, None)]
    assert len(of(ring)["gaps"]) == 2
    # Who looks back, within 60 degrees, and from the same place.
    ways = [(0.0, 0.0, 10.0), (5.0, 0.0, 200.0), (300.0, 0.0, 90.0), (305.0, 0.0, 130.0)]
    assert of(ways)["oneWay"] == [2, 3]
    assert of([(0.0, 0.0, None)])["withHeading"] == 0


def test_coverage_of_a_large_map_is_quick_enough_to_wait_for(evaluate: Evaluate) -> None:
    """Twenty thousand references in streets with gaps; a quadratic way would never end."""
    found = evaluate(
        "coverage",
        """(module) => {
          const points = [];
          for (let street = 0; street < 100; street += 1) {
            for (let step = 0; step < 200; step += 1) {
              points.push({at: [step * 10, street * 60], heading: 90});
            }
          }
          const {stretches, gaps, oneWay} = module.coverageOf(points);
          return [stretches, gaps.length, oneWay.length];
        }""",
        None,
    )
    assert found == [100, 99, 20_000]


def test_positions_from_a_table(evaluate: Evaluate) -> None:
    def read(text: str) -> Any:
        function = "(module, text) => Object.fromEntries(module.readPositions(text))"
        return evaluate("positions", function, text)

    assert read("file,lat,lon\na.jpg,1,2\n") == {"a.jpg": {"lat": "1", "lon": "2"}}
    assert read("\ufeffLongitude,Name,Latitude,Yaw\r\n2,x/b.jpg,1,90\r\n\r\n") == {
        "b.jpg": {"lat": "1", "lon": "2", "heading": "90"}
    }
    quoted = 'time,file\n2026-01-01T00:00:00Z,"c\\d, ""e"".jpg"'
    assert read(quoted) == {'d, "e".jpg': {"captured_at": "2026-01-01T00:00:00Z"}}
    assert read("file,lat\nonly.jpg,\n") == {"only.jpg": {}}
    assert read("file") == {}


def test_quantiles_of_histograms(evaluate: Evaluate) -> None:
    text = "\n".join(
        [
            "# TYPE t histogram",
            't_bucket{stage="a",le="0.1"} 0',
            't_bucket{stage="a",le="0.2"} 10',
            't_bucket{stage="a",le="0.4"} 20',
            't_bucket{stage="a",le="+Inf"} 20',
            't_bucket{stage="b \\"c\\"",le="+Inf"} 0',
            "depth 7",
        ]
    )
    function = """(module, [now, before]) => {
      const samples = module.parse(now);
      const found = module.histograms(samples, "t", "stage", module.parse(before));
      const a = found.get("a");
      return [[...found.keys()], module.total(a), module.quantile(a, 0.5),
              module.quantile(a, 0.75), module.quantile(found.get('b "c"'), 0.5),
              module.valueOf(samples, "depth"), module.valueOf(samples, "none")];
    }"""
    names, total, half, most, nothing, depth, none = evaluate("prometheus", function, [text, ""])
    assert names == ["a", 'b "c"']
    assert (total, half, most) == (20, pytest.approx(0.2), pytest.approx(0.3))
    assert (nothing, depth, none) == (None, 7, None)
    # Only what came since the earlier look counts.
    earlier = 't_bucket{stage="a",le="0.2"} 10\nt_bucket{stage="a",le="0.4"} 10'
    earlier += '\nt_bucket{stage="a",le="+Inf"} 10'
    _, total, half, *_ = evaluate("prometheus", function, [text, earlier])
    assert (total, half) == (10, pytest.approx(0.3))


def test_metres_and_angles(evaluate: Evaluate) -> None:
    function = """(module, [origin, place]) => {
      const plane = module.planeAround(origin);
      const at = plane.toMetres(place);
      return [at, plane.toDegrees(at)];
    }"""
    at, back = evaluate(
        "geometry", function, [{"lat": 60, "lon": 179.9}, {"lat": 60.01, "lon": -179.9}]
    )
    assert at == [pytest.approx(0.2 * 111_320 / 2), pytest.approx(0.01 * 111_320)]
    assert back["lat"] == pytest.approx(60.01)
    angle = "(module, [one, other]) => module.angleBetween(one, other)"
    assert evaluate("geometry", angle, [350, 10]) == 20
    assert evaluate("geometry", angle, [0, 180]) == 180


def test_names_of_places(evaluate: Evaluate) -> None:
    name = "(module, [external, id]) => module.placeName(external, id)"
    for external, expected in [
        ("drive7/000123.jpg", "000123.jpg"),
        ("@359666.47@5651730.78@32@U@51.0@6.9@p000000v0@@128.0@@@@20260504@day@.jpg", "p000000v0"),
        ("@odd@.jpg", "@odd@.jpg"),
        (None, "photo 456789"),
    ]:
        assert evaluate("format", name, [external, "0123456789"]) == expected
