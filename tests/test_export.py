"""Exports of a run and of a traffic log, read back by the programs they are for."""

import csv
import io
import json
import sys

import numpy as np
import pytest

from visfuse_cli.errors import InputError, OutputError, UsageError
from visfuse_cli.export.run import export
from visfuse_cli.files.ground_reference import parse_reference
from visfuse_cli.files.traffic_log import LoggedClip, TrafficLog

CRS = {"code": "EPSG:25833", "origin": [391000.0, 5820000.0]}  # Berlin


def _state(frame, position, velocity):
    size = len(position)
    covariance = np.diag([0.04] * size + [0.01] * size).tolist()
    box = {"image": [10.0 + frame, 20.0, 30.0, 40.0]}
    speed = float(np.linalg.norm(velocity))
    return {
        "frame": frame,
        "t": frame / 25,
        "position": position,
        "velocity": velocity,
        "covariance": covariance,
        "speed": speed,
        "speed_sigma": 0.1,
        "box": box,
        "measured": frame != 2,
    }


def _track(identity, states, rejected=None, **more):
    summary = {"t_start": 0.0, "t_end": 0.2, "speed": 10.0, "speed_ci95": [9.8, 10.2], "rejected": rejected}
    return {"id": identity, "class": "car", "summary": summary, "states": states} | more


@pytest.fixture
def run(tmp_path):
    return _run(tmp_path / "run")


def _run(folder, crs=CRS, tracks=None, reference="ground"):
    if tracks is None:
        first = [_state(k, [0.4 * k, 5.0], [10.0, 0.0]) for k in range(6)]
        second = [_state(k, [3.0, 50.0 - 0.4 * k], [0.0, -10.0]) for k in range(3, 5)]
        tracks = [_track(1, first), _track(2, second), _track(3, [_state(0, [1.0, 1.0], [0.0, 0.0])], "too short")]
    folder.mkdir()
    (folder / "tracks.json").write_text(json.dumps({"frame_of_reference": reference, "tracks": tracks}))
    (folder / "run.json").write_text(json.dumps({"crs": crs}))
    return folder


def test_csv_holds_every_state(run):
    rows = list(csv.DictReader(io.StringIO(export(run, "csv", None))))
    assert [(row["track_id"], row["frame"]) for row in rows] == [
        *(("1", str(k)) for k in range(6)),
        *(("2", str(k)) for k in range(3, 5)),
    ]
    assert rows[1]["x"] == "0.4"
    assert rows[1]["sigma_x"] == "0.2"
    assert rows[1]["z"] == rows[1]["rejected"] == ""
    assert rows[2]["measured"] == "False"
    assert rows[2]["box_image_x"] == "12.0"
    everything = export(run, "csv", None, rejected=True)
    assert "too short" in everything


def test_pandas_reads_csv_and_parquet_alike(run, tmp_path):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra `parquet`)")
    export(run, "csv", tmp_path / "t.csv")
    export(run, "parquet", tmp_path / "t.parquet")
    text, columns = pandas.read_csv(tmp_path / "t.csv"), pandas.read_parquet(tmp_path / "t.parquet")
    assert list(text.columns) == list(columns.columns)
    assert len(text) == len(columns) == 8
    for name in ("track_id", "frame", "t", "x", "vy", "speed", "sigma_x", "box_image_w"):
        np.testing.assert_array_equal(text[name], columns[name])
    assert columns["z"].isna().all()
    assert columns["measured"].tolist() == text["measured"].tolist()


def test_trackeval_reads_mot(run, tmp_path):
    datasets = pytest.importorskip("trackeval.datasets", reason="trackeval is not installed (extra `evaluate`)")
    for kind, name in (("gt", "gt/clip/gt/gt.txt"), ("ours", "trackers/MOT17-train/visfuse/data/clip.txt")):
        path = tmp_path / name
        path.parent.mkdir(parents=True)
        text = export(run, "mot", None)
        path.write_text(text.replace(",-1\n", ",1,1\n") if kind == "gt" else text)
    (tmp_path / "gt/clip/seqinfo.ini").write_text("[Sequence]\nname=clip\nseqLength=6\n")
    settings = datasets.MotChallenge2DBox.get_default_dataset_config() | {
        "GT_FOLDER": str(tmp_path / "gt"),
        "TRACKERS_FOLDER": str(tmp_path / "trackers"),
        "TRACKERS_TO_EVAL": ["visfuse"],
        "SEQ_INFO": {"clip": None},
        "SKIP_SPLIT_FOL": True,
        "DO_PREPROC": False,
        "PRINT_CONFIG": False,
    }
    settings["TRACKERS_FOLDER"] = str(tmp_path / "trackers" / "MOT17-train")
    data = datasets.MotChallenge2DBox(settings).get_raw_seq_data("visfuse", "clip")
    assert data["num_timesteps"] == 6
    assert [len(ids) for ids in data["tracker_ids"]] == [1, 1, 1, 2, 2, 1]
    np.testing.assert_allclose(data["tracker_dets"][3], [[13, 20, 30, 40], [13, 20, 30, 40]])


def test_mot_rows(run):
    rows = [line.split(",") for line in export(run, "mot", None).splitlines()]
    assert [(int(row[0]), int(row[1])) for row in rows] == sorted((int(row[0]), int(row[1])) for row in rows)
    assert rows[1] == ["2", "1", "11.000", "20.000", "30.000", "40.000", "1", "0.4000", "5.0000", "-1"]


def test_mot_of_several_views_and_clips(tmp_path):
    left = _state(0, [0.0, 0.0, 9.0], [0.0, 0.0, 1.0])
    left["box"] = {"left": [0, 0, 5, 5], "right": [1, 0, 5, 5]}
    folder = _run(tmp_path / "stereo", None, [_track(1, [left])], "left-camera")
    with pytest.raises(UsageError, match="give one of left, right"):
        export(folder, "mot", None)
    assert export(folder, "mot", None, view="right").startswith("1,1,1.000,0.000")
    clips = [_track(k + 1, [_state(0, [0.0, 0.0], [1.0, 0.0])], clip=name) for k, name in enumerate("ab")]
    folder = _run(tmp_path / "clips", None, clips)
    with pytest.raises(UsageError, match="--clip: give one of a, b"):
        export(folder, "mot", None)
    with pytest.raises(UsageError, match="--clip: c: there is none"):
        export(folder, "mot", None, clip="c")
    assert export(folder, "mot", None, clip="b").splitlines()[0].startswith("1,2,")


def test_geojson_lies_where_the_survey_was(run):
    pyproj = pytest.importorskip("pyproj", reason="pyproj is not installed (extra `geo`)")
    found = json.loads(export(run, "geojson", None))
    assert [feature["id"] for feature in found["features"]] == [1, 2]
    line = found["features"][0]["geometry"]["coordinates"]
    assert len(line) == 6 == len(found["features"][0]["properties"]["times"])
    geod = pyproj.Geod(ellps="GRS80")
    azimuth, _, way = geod.inv(*line[0], *line[-1])
    assert way == pytest.approx(2.0, rel=1e-3)  # five steps of 0.4 m on the ellipsoid; the grid's scale is 0.9997
    assert azimuth == pytest.approx(90, abs=2)  # to the east, but for the meridians' convergence
    assert line[0] == pytest.approx([13.4006, 52.5183], abs=0.01)


def test_geopackage_is_read_back(run, tmp_path):
    pytest.importorskip("pyproj", reason="pyproj is not installed (extra `geo`)")
    raw = pytest.importorskip("pyogrio.raw", reason="pyogrio is not installed (extra `geo`)")
    shapely = pytest.importorskip("shapely", reason="shapely is not installed (extra `geo`)")
    export(run, "gpkg", tmp_path / "t.gpkg", rejected=True)
    about, _, shapes, fields = raw.read(tmp_path / "t.gpkg", layer="tracks")
    assert about["crs"] == "EPSG:25833"
    values = dict(zip(about["fields"], fields, strict=True))
    assert values["track_id"].tolist() == [1, 2, 3]
    assert values["rejected"].tolist() == [None, None, "too short"]
    line = shapely.get_coordinates(shapely.from_wkb(shapes[0]))
    np.testing.assert_allclose(line[-1], [391002.0, 5820005.0])
    about, _, shapes, _ = raw.read(tmp_path / "t.gpkg", layer="states")
    assert len(shapes) == 9
    assert [path.name for path in tmp_path.iterdir() if "partial" in path.name or ".visfuse" in path.name] == []


def test_a_run_without_tracks_exports_in_every_form(tmp_path):
    folder = _run(tmp_path / "none", tracks=[])
    assert export(folder, "mot", None) == ""
    assert len(export(folder, "csv", None).splitlines()) == 1
    assert json.loads(export(folder, "json", None)) == []
    pytest.importorskip("pyogrio", reason="pyogrio is not installed (extra `geo`)")
    assert json.loads(export(folder, "geojson", None))["features"] == []
    export(folder, "gpkg", tmp_path / "none.gpkg")
    assert (tmp_path / "none.gpkg").stat().st_size > 0


def test_a_log_is_exported_in_order_whatever_the_order_of_writing(tmp_path):
    row = {
        "track_id": 1,
        "t_start": "2.000",
        "t_end": "3.000",
        "time_utc": "",
        "direction": "90.0",
        "lane": "",
        "speed_kmh": "50.25",
        "ci95_low_kmh": "49.00",
        "ci95_high_kmh": "51.00",
        "distance_m": "14.00",
        "n_frames": 25,
    }
    clips = [LoggedClip(f"sha{k}", "a", f"{k}.mp4", None, 4.0, 100, "1") for k in range(3)]
    rows = [row, row | {"track_id": 2, "t_start": "1.000"}]
    for name, order in (("up", clips), ("down", clips[::-1])):
        with TrafficLog(tmp_path / name) as log:
            for clip in order:
                log.add(clip, rows)
    assert export(tmp_path / "up", "csv", None) == export(tmp_path / "down", "csv", None)
    found = list(csv.DictReader(io.StringIO(export(tmp_path / "up", "csv", None))))
    assert [(each["clip"], each["track_id"]) for each in found[:3]] == [("0.mp4", "2"), ("0.mp4", "1"), ("1.mp4", "2")]
    assert found[0]["speed_kmh"] == "50.25"
    assert found[0]["lane"] == ""


@pytest.mark.parametrize(
    ("form", "more", "error", "message"),
    [
        ("xml", {}, UsageError, "one of csv"),
        ("parquet", {}, UsageError, "name a file with --out"),
        ("csv", {"view": "left"}, UsageError, "go with --format mot"),
        ("mot", {"view": "left"}, UsageError, "there is none of this name of image"),
    ],
)
def test_a_wrong_export_is_refused(run, form, more, error, message):
    with pytest.raises(error, match=message):
        export(run, form, None, **more)


@pytest.mark.parametrize(("form", "library"), [("parquet", "pyarrow"), ("geojson", "pyproj"), ("gpkg", "shapely")])
def test_without_its_library_a_form_is_one_line(form, library, run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(UsageError, match=r"pip install 'visfuse-cli\["):
        export(run, form, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_exported_is_said(run, tmp_path):
    with pytest.raises(InputError, match="no such run folder"):
        export(tmp_path / "nowhere", "csv", None)
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(OutputError, match="exists; give --overwrite"):
        export(run, "csv", tmp_path / "taken")
    with pytest.raises(InputError, match="no place on earth"):
        export(_run(tmp_path / "nowhere", crs=None), "geojson", None)
    folder = _run(tmp_path / "odd", tracks=[{"id": 1, "states": [{}], "summary": {}}])
    with pytest.raises(InputError, match="not the tracks of a run"):
        export(folder, "csv", None)
    (tmp_path / "odd" / "tracks.json").write_text("{")
    with pytest.raises(InputError, match="not JSON"):
        export(tmp_path / "odd", "csv", None)


@pytest.mark.parametrize(
    ("crs", "origin", "message"),
    [
        (None, "1,2", "needs --crs"),
        ("UTM33", None, "EPSG:NUMBER"),
        ("EPSG:4326", None, "in degrees"),
        ("EPSG:2263", None, "US survey foot"),
        ("EPSG:999999", None, "no such coordinate reference"),
        ("EPSG:25833", "1;2", "E,N"),
        ("EPSG:25833", "1,nan", "finite"),
    ],
)
def test_a_wrong_reference_is_refused(crs, origin, message):
    pytest.importorskip("pyproj", reason="pyproj is not installed (extra `geo`)")
    with pytest.raises(UsageError, match=message):
        parse_reference(crs, origin)
