"""What can happen on the way to a watered pot, on stand-ins and virtual time."""

import pytest
from standin import in_garden

from core.allocation.bidding import done_s
from core.geometry.planar import distance_m
from core.robots import gardener
from core.wire.market import ReservationRequest
from core.wire.robot import JobRequest, ResumeRequest, StopRequest
from robot_service.fitness import AGAIN_S


def poured(garden, plant, robot="robot-1"):
    return sum(ml for dock, ml in garden.bodies[robot].poured_at if dock == plant)


def test_an_awarded_watering_is_driven_docked_poured_and_reported():
    async def story(garden):
        bid = await garden.bid("plant-1")
        began_s = garden.clock.now()
        assert (await garden.award("plant-1")).status_code == 201
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 120.0)
        took_s = garden.clock.now() - began_s
        assert plant.ended.state == "done"
        assert plant.ended.delivered_ml == pytest.approx(150.0, abs=0.5)
        assert poured(garden, "plant-1") == pytest.approx(150.0, abs=0.5)
        assert done_s(bid.breakdown) == pytest.approx(took_s, rel=0.5)
        phases = [r.phase.partition(":")[0] for r in plant.reports]
        assert [p for p in ("navigate", "dock", "act") if p in phases] == ["navigate", "dock", "act"]

    in_garden(story)


@pytest.mark.parametrize("how", ["beam", "seek-dock"])
def test_either_way_of_docking_ends_with_charge_current_at_the_far_pot(how):
    async def story(garden):
        await garden.award("plant-3")
        await garden.until(lambda: garden.plants["plant-3"].ended, 150.0)
        assert garden.plants["plant-3"].ended.state == "done"

    in_garden(story, seed=2, docking=how)


@pytest.mark.parametrize("ahead_s", [-5000.0, 5000.0])
def test_a_body_that_is_started_anew_leaves_the_robot_where_it_is(ahead_s):
    async def story(garden):
        await garden.award("plant-3")
        robot, where = garden.bodies["robot-1"], garden.brains["robot-1"].robot.where
        await garden.until(lambda: robot.left_m > 1.0, 60.0)
        stamp_s = garden.brains["robot-1"].body.state.stamp_s
        await robot.begin_anew(ahead_s)
        await garden.until(lambda: robot.link is not None, 5.0)
        for _ in range(40):
            await garden.clock.sleep(0.05)
            assert distance_m(where.pose, robot.pose) < 0.1
            assert where.lost == ""
            assert 0.0 <= garden.brains["robot-1"].body.state.stamp_s - stamp_s < 5.0
        await garden.until(lambda: garden.plants["plant-3"].ended, 150.0)
        assert garden.plants["plant-3"].ended.state == "done"

    in_garden(story)


@pytest.mark.parametrize("ahead_s", [-5000.0, 5000.0])
def test_what_is_under_way_is_priced_by_the_brains_clock_whatever_its_bodys_says(ahead_s):
    async def story(garden):
        robot = garden.bodies["robot-1"]
        await robot.begin_anew(ahead_s)
        await garden.award("plant-1")
        await garden.until(lambda: poured(garden, "plant-1") > 75.0, 120.0)
        bid = await garden.bid("plant-2")
        assert 5.0 <= bid.breakdown.current_s < 25.0

    in_garden(story)


def test_the_papers_filter_drives_it_too():
    async def story(garden):
        await garden.award("plant-4")
        await garden.until(lambda: garden.plants["plant-4"].ended, 150.0)
        assert garden.plants["plant-4"].ended.state == "done"

    in_garden(story, seed=3, localisation="exponential")


def test_two_awards_are_done_one_after_the_other_and_both_leases_are_kept():
    async def story(garden):
        await garden.award("plant-1")
        await garden.award("plant-2")
        first, second = garden.plants["plant-1"], garden.plants["plant-2"]
        await garden.until(lambda: second.ended, 200.0)
        assert first.ended.state == second.ended.state == "done"
        assert second.reports[0].state == "awarded"

    in_garden(story)


def test_a_robot_on_its_way_serves_a_nearer_plant_first_and_then_goes_on():
    async def story(garden):
        await garden.award("plant-3")
        brain, far, near = garden.brains["robot-1"], garden.plants["plant-3"], garden.plants["plant-1"]
        await garden.until(lambda: brain.robot.activity.v_mps > 0.2, 20.0)
        await garden.award("plant-1")
        assert [entry.plant_id for entry in brain.queue.entries] == ["plant-1", "plant-3"]
        await garden.until(lambda: far.reports[-1].state == "awarded", 2.0)
        await garden.until(lambda: far.ended, 200.0)
        assert near.ended.state == far.ended.state == "done"
        told = [event.what for event in brain.events.since(0)]
        assert "puts water plant-3 off: plant-1 comes first" in told
        assert told.index("water done") < told.index("begins water plant-3", told.index("begins water plant-3") + 1)

    in_garden(story)


@pytest.mark.parametrize("what", ["deadline", "docking"])
def test_a_task_that_cannot_wait_is_not_put_off(what):
    async def story(garden):
        brain, award = garden.brains["robot-1"], garden.award_of("plant-3")
        if what == "deadline":
            in_time = award.announcement.model_copy(update={"within_s": 300.0})
            award = award.model_copy(update={"announcement": in_time})
        await garden.call("robot-1", "POST", "/tasks", award, as_="plant-3")
        job = "navigate" if what == "deadline" else "dock"
        await garden.until(lambda: brain.robot.activity.job == job, 60.0)
        await garden.award("plant-1")
        assert [entry.plant_id for entry in brain.queue.entries] == ["plant-3", "plant-1"]
        await garden.until(lambda: garden.plants["plant-1"].ended, 200.0)
        assert not [event.what for event in brain.events.since(0) if " off: " in event.what]

    in_garden(story)


def test_a_kill_ends_the_epoch_it_names_and_no_later_one():
    async def story(garden):
        await garden.award("plant-3", epoch=1)
        await garden.award("plant-3", epoch=2)
        late = await garden.call("robot-1", "DELETE", "/tasks/plant-3:1?epoch=1", as_="plant-3")
        assert late.status_code == 409
        assert garden.brains["robot-1"].queue.entries
        meant = await garden.call("robot-1", "DELETE", "/tasks/plant-3:1?epoch=2", as_="plant-3")
        assert meant.status_code == 200
        await garden.until(lambda: not garden.brains["robot-1"].queue.entries, 2.0)

    in_garden(story)


def test_a_task_killed_on_the_way_is_dropped_and_the_robot_goes_home_without_pouring():
    async def story(garden):
        await garden.award("plant-3")
        robot = garden.brains["robot-1"].robot
        await garden.until(lambda: robot.activity.v_mps > 0.2, 20.0)
        answer = await garden.call("robot-1", "DELETE", "/tasks/plant-3:1", as_="plant-3")
        assert answer.status_code == 200
        await garden.until(lambda: not garden.brains["robot-1"].queue.entries, 2.0)
        home = (0.0, 1.20)
        await garden.until(lambda: distance_m(garden.bodies["robot-1"].pose, home) < 0.2 and not robot.moving, 60.0)
        assert poured(garden, "plant-3") == 0.0
        assert garden.plants["plant-3"].docks.loan("plant-3", garden.clock.now()).robot_id == ""

    in_garden(story)


def test_a_task_killed_at_the_dock_before_the_permit_undocks():
    async def story(garden):
        await garden.award("plant-1")
        plant = garden.plants["plant-1"]
        await garden.until(lambda: garden.bodies["robot-1"].docked, 80.0)
        await garden.call("robot-1", "DELETE", "/tasks/plant-1:1", as_="plant-1")
        await garden.until(lambda: not garden.bodies["robot-1"].dock, 20.0)
        await garden.until(lambda: not plant.docks.loan("plant-1", garden.clock.now()).robot_id, 30.0)
        assert poured(garden, "plant-1") == 0.0

    in_garden(story)


def test_a_task_killed_while_pouring_is_finished_and_reported_honestly():
    async def story(garden):
        await garden.award("plant-1")
        await garden.until(lambda: garden.bodies["robot-1"].pumping, 80.0)
        await garden.call("robot-1", "DELETE", "/tasks/plant-1:1", as_="plant-1")
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 60.0)
        assert plant.ended.state == "done"
        assert plant.ended.delivered_ml == pytest.approx(poured(garden, "plant-1"), abs=0.5)
        assert poured(garden, "plant-1") == pytest.approx(150.0, abs=0.5)

    in_garden(story)


def test_a_plant_that_answers_keep_false_loses_the_robot():
    async def story(garden):
        await garden.award("plant-3")
        await garden.until(lambda: garden.brains["robot-1"].robot.activity.v_mps > 0.2, 20.0)
        garden.plants["plant-3"].keep = False
        await garden.until(lambda: not garden.brains["robot-1"].queue.entries, 6.0)
        assert poured(garden, "plant-3") == 0.0

    in_garden(story)


def test_a_plant_that_fell_silent_loses_the_robot_when_the_lease_ends():
    async def story(garden):
        await garden.award("plant-3")
        await garden.until(lambda: garden.plants["plant-3"].reports, 5.0)
        garden.plants["plant-3"].silent = True
        brain = garden.brains["robot-1"]
        await garden.until(lambda: not brain.queue.entries, 14.0)
        assert poured(garden, "plant-3") == 0.0
        assert any("the lease ran out" in event.what for event in brain.events.since(0))

    in_garden(story)


def test_a_refused_permit_pours_nothing_and_says_why():
    async def story(garden):
        garden.plants["plant-1"].refuse_permit = "measure first"
        await garden.award("plant-1")
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 100.0)
        assert plant.ended.state == "failed"
        assert "measure first" in plant.ended.reason
        assert poured(garden, "plant-1") == 0.0

    in_garden(story)


def test_a_held_dock_is_waited_for_at_a_distance_with_the_reason():
    async def story(garden):
        plant, robot = garden.plants["plant-1"], garden.brains["robot-1"]
        held = plant.docks.reserve(ReservationRequest(robot_id="robot-9", for_s=600.0), garden.clock.now())
        await garden.award("plant-1")
        await garden.until(lambda: "robot-9" in robot.state().waiting, 60.0)
        await garden.clock.sleep(10.0)
        dock = plant.card.dock
        assert distance_m(garden.bodies["robot-1"].pose, (dock.x_m, dock.y_m)) > 0.7
        plant.docks.release(held.reservation_id, "")
        await garden.until(lambda: plant.ended, 120.0)
        assert plant.ended.state == "done"

    in_garden(story)


def test_a_robot_carried_off_its_dock_gives_it_back_on_its_way_to_another():
    async def story(garden):
        await garden.award("plant-1")
        await garden.award("plant-2")
        body, first = garden.bodies["robot-1"], garden.plants["plant-1"]
        await garden.until(lambda: body.docked, 80.0)
        body.pose = (0.0, 0.2, 0.0)
        await garden.until(lambda: garden.plants["plant-2"].ended, 200.0)
        assert first.ended.state == "failed"
        assert garden.plants["plant-2"].ended.state == "done"
        assert first.docks.loan("plant-1", garden.clock.now()).robot_id == ""

    in_garden(story)


def test_a_servo_board_that_forgot_the_arm_makes_it_fold_before_it_reaches_and_pours():
    async def story(garden):
        await garden.award("plant-1")
        body, robot = garden.bodies["robot-1"], garden.brains["robot-1"].robot
        await garden.until(lambda: robot.activity.job == "dock", 80.0)
        body.forget_arm()
        await garden.until(lambda: body.arm is not None, 60.0)
        assert body.arm == gardener.ARM_HOME_RAD
        await garden.until(lambda: garden.plants["plant-1"].ended, 80.0)
        assert garden.plants["plant-1"].ended.state == "done"
        assert poured(garden, "plant-1") == pytest.approx(150.0, abs=0.5)

    in_garden(story)


def test_a_robot_that_rests_on_a_dock_leaves_when_somebody_wants_it():
    async def story(garden):
        await garden.award("plant-1")
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 120.0)
        await garden.until(lambda: plant.docks.loan("plant-1", garden.clock.now()).yielding, 15.0)
        wish = ReservationRequest(robot_id="robot-9", for_s=30.0)

        def granted():
            try:
                return plant.docks.reserve(wish, garden.clock.now())
            except Exception:
                return None

        await garden.until(granted, 40.0)
        assert not garden.bodies["robot-1"].dock

    in_garden(story)


def test_an_unmapped_obstacle_is_bumped_backed_off_from_and_driven_round():
    async def story(garden):
        garden.plane.hidden.append((0.0, 0.5, 0.05))
        await garden.call("robot-1", "POST", "/jobs", JobRequest(kind="goto", x_m=0.0, y_m=0.0, yaw_rad=0.0))
        await garden.until(lambda: distance_m(garden.bodies["robot-1"].pose, (0.0, 0.0)) < 0.05, 120.0)
        assert any(e.kind == "bump" for e in garden.brains["robot-1"].events.since(0))

    in_garden(story)


def test_a_neighbouring_pot_that_attracts_the_docking_robot_is_noticed():
    async def story(garden):
        body, plant = garden.bodies["robot-1"], garden.plants["plant-1"]
        await garden.award("plant-1")
        await garden.until(lambda: garden.brains["robot-1"].robot.activity.job == "dock", 80.0)
        body.attracted_to = "plant-3"
        await garden.until(lambda: any(e.kind == "dock" for e in garden.brains["robot-1"].events.since(0)), 90.0)
        body.attracted_to = ""
        await garden.until(lambda: plant.ended, 150.0)
        assert plant.ended.state == "done"
        assert poured(garden, "plant-3") == 0.0

    in_garden(story)


def test_a_robot_with_too_little_water_prices_and_does_the_refill_first():
    async def story(garden):
        full = await garden.bid("plant-1")
        await garden.empty_tank("robot-1", 60.0)
        bid = await garden.bid("plant-1")
        assert bid.breakdown.refill_s > 30.0
        assert bid.cost_s > full.cost_s + 30.0
        await garden.award("plant-1")
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 300.0)
        assert plant.ended.state == "done"
        assert garden.station.taps >= 1
        assert garden.bodies["robot-1"].tank_ml > 1200.0
        assert garden.station.docks.loan("tap", garden.clock.now()).robot_id == ""

    in_garden(story)


def test_a_robot_low_on_charge_looks_for_a_dock_by_itself_and_still_answers_bids():
    async def story(garden):
        garden.bodies["robot-1"].battery_ratio = 0.2
        await garden.until(lambda: garden.brains["robot-1"].robot.activity.job == "charge", 120.0)
        assert garden.bodies["robot-1"].docked
        bid = await garden.bid("plant-1")
        assert bid.cost_s is not None

    in_garden(story)


def test_the_e_stop_halts_the_wheels_latches_and_gives_the_task_back():
    async def story(garden):
        await garden.award("plant-3")
        body = garden.bodies["robot-1"]
        await garden.until(lambda: body.v > 0.2, 20.0)
        answer = await garden.call("robot-1", "POST", "/stop", StopRequest(reason="cat"), as_="viewer")
        assert answer.status_code == 200
        assert answer.json()["stopped"]
        assert body.v == 0.0
        plant = garden.plants["plant-3"]
        await garden.until(lambda: plant.ended, 5.0)
        assert "stopped by viewer: cat" in plant.ended.reason
        assert (await garden.bid("plant-3")).reason.startswith("stopped by")
        release = ResumeRequest(stop_number=answer.json()["stop_number"])
        assert (await garden.call("robot-1", "POST", "/resume", release, as_="viewer")).status_code == 403
        assert body.stopped
        assert (await garden.call("robot-1", "POST", "/resume", release, as_="operator")).json()["stopped"] is False
        await garden.award("plant-3", number=2)
        await garden.until(lambda: plant.reports[-1].state == "done", 150.0)

    in_garden(story)


@pytest.mark.parametrize("when", ["drive", "dock", "pour"])
def test_a_brain_killed_in_the_act_stops_and_comes_back_with_an_empty_queue(when):
    async def story(garden):
        await garden.award("plant-1")
        body, robot = garden.bodies["robot-1"], garden.brains["robot-1"].robot
        moments = {
            "drive": lambda: body.v > 0.2,
            "dock": lambda: robot.activity.job == "dock" and body.v > 0.0,
            "pour": lambda: body.pumping,
        }
        await garden.until(moments[when], 90.0)
        await garden.kill("robot-1")
        await garden.clock.sleep(0.35)
        assert body.v == 0.0
        assert not body.pumping
        plant = garden.plants["plant-1"]
        plant.reports.clear()
        brain = garden.boot("robot-1")
        await garden.clock.sleep(15.0)
        assert not brain.queue.entries
        assert not plant.reports
        await garden.award("plant-2", number=3)
        await garden.until(lambda: garden.plants["plant-2"].ended, 200.0)
        assert garden.plants["plant-2"].ended.state == "done"
        assert poured(garden, "plant-1") <= 150.5

    in_garden(story)


def test_a_stuck_pump_is_reported_with_what_came_out():
    async def story(garden):
        await garden.award("plant-1")
        body = garden.bodies["robot-1"]
        await garden.until(lambda: body.pumped_ml > 50.0, 90.0)
        body.pump_stuck = True
        plant = garden.plants["plant-1"]
        await garden.until(lambda: plant.ended, 60.0)
        assert plant.ended.state == "failed"
        assert plant.ended.delivered_ml == pytest.approx(poured(garden, "plant-1"), abs=0.5)
        assert "pump" in plant.ended.reason

    in_garden(story)


def test_with_a_broken_pump_what_waits_is_given_back_with_the_reason_and_no_water_is_promised():
    async def story(garden):
        brain, body = garden.brains["robot-1"], garden.bodies["robot-1"]
        body.pump_stuck = True
        for number, name in enumerate(("plant-1", "plant-2", "plant-3"), 1):
            await garden.award(name, number=number)
        waiting = [garden.plants[name] for name in ("plant-2", "plant-3")]
        await garden.until(lambda: all(plant.ended for plant in waiting), 120.0)
        assert garden.plants["plant-1"].ended.state == "failed"
        for plant in waiting:
            assert plant.ended.state == "failed"
            assert plant.ended.reason.startswith("the pump has failed: the pump stopped at 0 ml")
            assert not plant.permits, "it was not even driven to"
        assert not brain.queue.entries
        assert "the pump has failed" in (await garden.bid("plant-1")).reason
        assert any("the pump has failed" in why for why in brain.state().down)

    in_garden(story)


def test_a_pump_that_failed_is_tried_again_after_a_while_ever_more_seldom():
    async def story(garden):
        body = garden.bodies["robot-1"]
        body.pump_stuck = True
        for number, rest_s in ((1, AGAIN_S), (2, 2 * AGAIN_S)):
            garden.plants["plant-1"].reports.clear()
            await garden.award("plant-1", number=number)
            await garden.until(lambda: garden.plants["plant-1"].ended, 120.0)
            await garden.clock.sleep(rest_s - 40.0)  # it folded its arm first
            assert (await garden.bid("plant-1")).cost_s is None
            await garden.clock.sleep(40.0)
            assert (await garden.bid("plant-1")).cost_s is not None
        body.pump_stuck = False
        garden.plants["plant-1"].reports.clear()
        await garden.award("plant-1", number=3)
        await garden.until(lambda: garden.plants["plant-1"].ended, 120.0)
        assert garden.plants["plant-1"].ended.state == "done"
        assert not garden.brains["robot-1"].state().down

    in_garden(story)


def test_whoever_releases_a_robot_has_looked_at_its_pump():
    async def story(garden):
        body = garden.bodies["robot-1"]
        body.pump_stuck = True
        await garden.award("plant-1")
        await garden.until(lambda: garden.plants["plant-1"].ended, 120.0)
        assert (await garden.bid("plant-1")).cost_s is None
        body.stopped, body.stopped_by = True, "operator"
        await garden.clock.sleep(1.0)
        body.stopped, body.pump_stuck = False, False
        await garden.clock.sleep(1.0)
        assert (await garden.bid("plant-1")).cost_s is not None

    in_garden(story)


def test_a_tank_that_empties_with_the_pump_off_raises_an_alarm_and_gives_waterings_back():
    async def story(garden):
        brain, body = garden.brains["robot-1"], garden.bodies["robot-1"]
        await garden.award("plant-3")
        await garden.until(lambda: body.v > 0.2, 20.0)
        await garden.award("plant-2", number=2)
        for _ in range(100):
            body.tank_ml -= 1.0
            await garden.clock.sleep(0.1)
            given_back = [plant.ended for plant in garden.plants.values() if plant.ended]
            if given_back:
                break
        assert given_back[0].reason.startswith("the tank lost"), given_back
        alarms = [entry.what for entry in brain.events.since(0) if entry.kind == "alarm"]
        assert len(alarms) == 1
        assert alarms[0].endswith("ml while the pump was off")
        assert "the tank lost" in (await garden.bid("plant-1")).reason

    in_garden(story)


def test_at_a_dry_tap_what_there_is_water_for_stays_and_the_rest_is_given_back_with_the_reason():
    async def story(garden):
        brain = garden.brains["robot-1"]
        garden.station.dry = True
        await garden.empty_tank("robot-1", 60.0)
        await garden.award("plant-1", number=1)
        await garden.award("plant-2", number=2)
        gone = [garden.plants[name] for name in ("plant-1", "plant-2")]
        await garden.until(lambda: all(plant.ended for plant in gone), 200.0)
        for plant in gone:
            assert plant.ended.state == "failed"
            assert plant.ended.reason.startswith("no water at station/tap: the tank does not fill"), plant.ended
            assert not plant.permits
        assert not brain.queue.entries
        refused = await garden.bid("plant-1")
        assert refused.cost_s is None
        assert "no tap" in refused.reason
        assert (await garden.bid("plant-1", dose_ml=20.0)).cost_s is not None
        garden.station.dry = False
        await garden.clock.sleep(AGAIN_S)
        bid = await garden.bid("plant-1")
        assert bid.cost_s is not None
        assert bid.breakdown.refill_s > 30.0

    in_garden(story)


def test_a_blind_robot_stops_looks_around_and_says_that_it_is_lost():
    async def story(garden):
        await garden.award("plant-3")
        body, brain = garden.bodies["robot-1"], garden.brains["robot-1"]
        await garden.until(lambda: body.v > 0.2, 20.0)
        body.blind = True
        await garden.until(lambda: "lost" in brain.state().waiting, 40.0)
        body.blind = False
        await garden.until(lambda: garden.plants["plant-3"].ended, 200.0)
        assert garden.plants["plant-3"].ended.state == "done"

    in_garden(story, seed=5)


def test_an_idle_robot_at_home_sends_nothing_and_its_body_rests():
    async def story(garden):
        await garden.clock.sleep(10.0)
        body, link = garden.bodies["robot-1"], garden.brains["robot-1"].body
        sent, states = link.sent, body.states
        await garden.clock.sleep(20.0)
        assert link.sent - sent <= 12
        assert body.states - states <= 50

    in_garden(story)


def test_two_robots_water_four_pots_and_never_touch():
    async def story(garden):
        for plant, robot in (("plant-1", "robot-2"), ("plant-3", "robot-1"), ("plant-2", "robot-2"), ("plant-4", "robot-1")):
            await garden.award(plant, robot)
        await garden.until(lambda: all(p.ended for p in garden.plants.values()), 500.0)
        assert [p.ended.state for p in garden.plants.values()] == ["done"] * 4
        assert garden.plane.closest_m > 2 * gardener.BODY_RADIUS_M + 0.02

    in_garden(story, robots=2)
