"""Certificates by hand: where a plan is worst, whether that is exact, and the status."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from cdiff_cli.constraints.state_sets import HalfSpace
from cdiff_cli.constraints.trajectory import stack
from cdiff_cli.evaluation.certificate import Saved, certificate, content_sha256, summary
from tests.problems import ball, chain, num, opaque, vec, waypoints

TASK = SimpleNamespace(name="plane", layout=("x", "y"), dt=0.5)
DISC = waypoints(ball("outside", centre=(0.0, 0.0), radius=1.0), "disc")
LEFT = waypoints(HalfSpace(vec(1.0, 0.0), num(1.0)), "left")  # x <= 1
CUT = np.array(
    [[[-3.0, 0.6], [-2.0, 0.6], [2.0, 0.6], [3.0, 0.6]]]
)  # safe waypoints; the middle segment is 0.4 deep in the disc


def certify(g, x, rollout=None, seeds=None):
    seeds = list(range(len(x))) if seeds is None else seeds
    executed = None if rollout is None else Saved(np.asarray(rollout), seeds, "r")
    proof = certificate(
        TASK, {"file": "c.yaml", "content": []}, g, Saved(np.asarray(x), seeds, "p"), executed
    )
    json.dumps(proof, allow_nan=False)
    return proof


def test_a_plan_that_cuts_a_disc_between_safe_waypoints_is_unsafe_between_them():
    (entry,) = certify(DISC, CUT, seeds=[42])["entries"]
    assert (entry["seed"], entry["constraint"], entry["status"]) == (
        42,
        "disc",
        "unsafe between waypoints",
    )
    at, on = entry["waypoints"], entry["segments"]
    assert at["worst"] == pytest.approx(1 - np.hypot(2, 0.6))
    assert (at["label"], at["tau"], at["time"], at["state"], at["safe"]) == (
        "disc@1",
        1,
        0.5,
        {"x": -2.0, "y": 0.6},
        True,
    )
    assert on["worst"] == pytest.approx(0.4)
    assert (on["segment"], on["exact"], on["safe"]) == (1, True, False)
    assert on["time"] == pytest.approx(0.75)  # halfway from tau = 1 to 2
    assert on["state"] == {"x": pytest.approx(0.0, abs=1e-8), "y": 0.6}


def test_a_plan_in_the_disc_at_a_waypoint_is_unsafe_there():
    (entry,) = certify(DISC, [[[-2.0, 0.0], [0.0, 0.25], [2.0, 0.0]]])["entries"]
    assert entry["status"] == "unsafe at waypoints"
    assert (entry["waypoints"]["tau"], entry["waypoints"]["worst"]) == (1, 0.75)
    assert entry["segments"]["worst"] >= 0.75


def test_a_plan_on_the_boundary_is_safe_and_one_bit_beyond_it_is_not():
    on, beyond = [[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [np.nextafter(1.0, 2.0), 0.0]]
    assert [entry["status"] for entry in certify(LEFT, [on, beyond])["entries"]] == [
        "safe",
        "unsafe at waypoints",
    ]


def test_entries_go_plan_by_plan_and_a_plan_counts_as_safe_only_under_all_constraints():
    beside = np.array([[0.0, 2.0]] * 4)  # safe under both
    far = np.array([[5.0, 0.0]] * 4)  # outside the disc, not left
    proof = certify(stack([DISC, LEFT]), [CUT[0], beside, far])
    assert [(e["seed"], e["constraint"]) for e in proof["entries"]] == [
        (i, c) for i in range(3) for c in ("disc", "left")
    ]
    assert proof["counts"] == {
        "plans": 3,
        "safe_at_waypoints": 1,
        "safe_on_segments": 1,
        "safe_executed": None,
    }
    assert summary(proof["counts"]) == "1 of 3 plans safe at the waypoints, 1 of 3 between them"


def test_the_header_says_what_was_certified():
    proof = certify(DISC, CUT)
    assert (proof["task"], proof["tolerance"], proof["plan_sha256"], proof["rollout_sha256"]) == (
        "plane",
        0,
        "p",
        None,
    )
    assert proof["constraints"] == {"file": "c.yaml", "sha256": content_sha256([])}


def test_the_content_hash_knows_order_of_constraints_but_not_of_keys():
    a, b = {"kind": "linear", "b": 1.0}, {"b": 1.0, "kind": "linear"}
    assert content_sha256([a]) == content_sha256([b])
    assert content_sha256([a, {}]) != content_sha256([{}, a])
    assert content_sha256([a]) != content_sha256([a | {"b": 1.5}])


def test_of_equal_waypoints_the_first_is_named_whatever_the_rounding():
    x = [[[0.0, 0.0], [0.5, 0.0], [0.5 + 1e-14, 0.0], [0.5, 0.0]]]
    (entry,) = certify(LEFT, x)["entries"]
    assert (entry["waypoints"]["tau"], entry["segments"]["segment"], entry["segments"]["time"]) == (
        1,
        0,
        0.5,
    )
    assert entry["waypoints"]["worst"] == -0.5 + 1e-14


def test_a_tie_never_names_a_safe_waypoint_as_the_place_of_a_violation():
    (entry,) = certify(LEFT, [[[0.0, 0.0], [1.0, 0.0], [1.0 + 1e-12, 0.0]]])["entries"]
    assert (entry["status"], entry["waypoints"]["tau"]) == ("unsafe at waypoints", 2)
    assert entry["segments"]["segment"] == 1


def test_a_chain_is_judged_by_its_steps_and_between_waypoints_by_its_barrier():
    """h = 1 - x and alpha 0.5: from h = 1 to 0.25 is too fast, although h stays positive.

    The step leads to waypoint 1.
    """
    (entry,) = certify(
        chain(HalfSpace(vec(1.0, 0.0), num(1.0)), 0.5), [[[0.0, 0.0], [0.75, 0.0], [0.75, 0.0]]]
    )["entries"]
    assert entry["status"] == "unsafe at waypoints"
    assert (
        entry["waypoints"]["worst"],
        entry["waypoints"]["label"],
        entry["waypoints"]["tau"],
    ) == (0.25, "c@0-1", 1)
    assert entry["waypoints"]["state"] == {"x": 0.75, "y": 0.0}
    assert (entry["segments"]["worst"], entry["segments"]["safe"]) == (-0.25, True)


def test_a_chain_of_one_waypoint_has_no_steps_but_a_barrier():
    (entry,) = certify(chain(ball("outside", centre=(0.0, 0.0), radius=1.0), 0.5), [[[3.0, 0.0]]])[
        "entries"
    ]
    assert entry["status"] == "safe"
    assert entry["waypoints"] == {
        "worst": None,
        "label": None,
        "tau": None,
        "time": None,
        "state": None,
        "safe": True,
    }
    assert (entry["segments"]["worst"], entry["segments"]["state"]) == (-2.0, {"x": 3.0, "y": 0.0})


def test_without_a_closed_form_nothing_is_promised_between_waypoints():
    below, above = [[0.0, 0.0], [0.5, 0.0]], [[0.0, 0.0], [1.5, 0.0]]
    proof = certify(opaque(lambda x: x[..., 0] - 1.0), [below, above])
    assert [entry["status"] for entry in proof["entries"]] == [
        "unknown between waypoints",
        "unsafe at waypoints",
    ]
    assert all(
        (entry["segments"]["exact"], entry["segments"]["safe"]) == (False, False)
        for entry in proof["entries"]
    )
    assert proof["entries"][0]["segments"]["segment"] is None
    assert proof["counts"] == {
        "plans": 2,
        "safe_at_waypoints": 1,
        "safe_on_segments": 0,
        "safe_executed": None,
    }


def test_rows_that_are_not_one_per_waypoint_have_a_label_but_no_place():
    (entry,) = certify(opaque(lambda x: x.sum((1, 2))[:, None]), [[[0.0, 0.0], [0.5, 0.0]]])[
        "entries"
    ]
    assert (
        entry["waypoints"]["label"],
        entry["waypoints"]["tau"],
        entry["waypoints"]["state"],
    ) == ("o@0", None, None)


def test_what_is_no_number_is_not_safe_and_not_in_the_json():
    x = [[[0.0, 0.0], [np.nan, 0.0], [0.0, 0.0]]]
    (entry,) = certify(LEFT, x)["entries"]
    assert entry["status"] == "unsafe at waypoints"
    assert (entry["waypoints"]["worst"], entry["waypoints"]["tau"]) == (None, 1)
    assert (entry["segments"]["worst"], entry["segments"]["safe"]) == (None, False)


def test_the_executed_path_is_judged_up_to_its_end():
    nothing = [np.nan, np.nan]
    rollout = [
        [[0.0, 0.0], [1.5, 0.0], [0.5, 0.0], nothing],
        [[0.0, 0.0], [0.25, 0.0], nothing, nothing],
    ]
    proof = certify(LEFT, [[[0.0, 0.0], [0.5, 0.0]]] * 2, rollout)
    first, second = (entry["executed"] for entry in proof["entries"])
    assert first == {
        "worst": 0.5,
        "step": 1,
        "time": 0.5,
        "state": {"x": 1.5, "y": 0.0},
        "safe": False,
    }
    assert second == {
        "worst": -0.75,
        "step": 1,
        "time": 0.5,
        "state": {"x": 0.25, "y": 0.0},
        "safe": True,
    }
    assert [entry["status"] for entry in proof["entries"]] == [
        "safe",
        "safe",
    ]  # the status is the plan's
    assert proof["counts"] == {
        "plans": 2,
        "safe_at_waypoints": 2,
        "safe_on_segments": 2,
        "safe_executed": 1,
    }
    assert summary(proof["counts"]).endswith("2 of 2 between them, 1 of 2 as executed")
    assert proof["rollout_sha256"] == "r"
