"""What the user typed as a record: from a command's options, and back to a command."""

from pathlib import Path

from cdiff_cli.commands.experiment import Request
from cdiff_cli.commands.resolve import resolve

CALIBRATE = "cdiff rollout --calibrate --level 0.99 --episodes 100 --seed 5000"


def test_a_request_takes_its_own_options_of_a_command_and_lists_become_tuples():
    options = {"task": "hopper", "n": 3, "env": ["wind=1"], "settings": None, "runs": Path("runs")}
    assert Request.from_options(options) == Request(task="hopper", n=3, env=("wind=1",))
    assert Request.from_options({}) == Request()


def test_the_calibration_command_repeats_what_plans_depend_on():
    assert Request(task="hopper", n=7, seed=3, device="cpu").calibration_command == (
        f"{CALIBRATE} --task hopper"
    )
    request = Request(
        task="ball-run",
        method="projected",
        constraints=Path("mine.yaml"),
        settings=("on=clean", "correction=latent"),
        execute=4,
        warm=0.3,
        action_noise=0.1,
        env=("pattern=leader", "collide=false"),
    )
    assert request.calibration_command == (
        f"{CALIBRATE} --task ball-run --method projected --constraints mine.yaml "
        "--set on=clean --set correction=latent --execute 4 --warm 0.3 --action-noise 0.1 "
        "--env pattern=leader --env collide=false"
    )


def test_an_experiment_is_recorded_as_resolved():
    one = resolve(Request(task="gaussian2d", n=3, seed=5, steps=20, settings=("rho=0.25",)))
    assert one.seeds == [5, 6, 7]
    assert one.settings["rho"] == 0.25
    assert one.row() == {
        "task": "gaussian2d",
        "constraints": "gaussian2d",
        "method": "alm",
        "preset": "recommended*",
        "on": "clean",
        "kernel": "ddpm",
    }
    record = one.record()
    assert record["preset"]["sampler"]["steps"] == 20
    assert record["preset"]["methods"] == {"alm": one.settings}
    assert record["options"]["settings"] == ["rho=0.25"]
    assert (record["checkpoint"], record["start"], record["dynamics"]) == (None, None, False)
    assert record["constraints"]["file"].endswith("gaussian2d.yaml")


def test_a_preset_as_it_stands_is_not_changed_and_its_steps_are_counted():
    one = resolve(Request(task="gaussian2d"))
    assert one.row()["preset"] == "recommended"
    assert one.preset.sampler.steps == 500
    assert resolve(Request(task="gaussian2d", steps=500)).row()["preset"] == "recommended"
    assert resolve(Request(task="gaussian2d", kernel="ddim")).row()["preset"] == "recommended*"
