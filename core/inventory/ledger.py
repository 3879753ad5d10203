"""Merging a scan into a plant's inventory (paper 000, section 5, algorithm 2 and fig. 10).

The paper keeps a probabilistic map and moves a confidence up and down by the detector's accuracy. Here the confidence is
the probability that the fruit hangs there, by Bayes: a sighting speaks for it as strongly as the detector is precise; not
being seen speaks against it as strongly as it should have been seen, which the plant learns for each fruit from each
direction: where it was seen from before it should be seen again, where it never was a leaf may hang between.
Pure Python: a pot runs it. Positions in the plant frame [m], times on the garden's clock [s].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median

from core.growth.belief import Observation, Pace, remember
from core.growth.stages import COLOURS, DAY_S, MISTAKE
from core.inventory.matching import assign
from core.inventory.track import Eye, Place, Track, logit, point, probability
from core.inventory.view import blocked, in_view
from core.wire.fruit import Accuracy, Colour, Fruit, Scan, Sighting, View

GATE = 16.0
"""A pair costs at most so much: squares of sigmas for the distance and the size, twice the log of the colour's odds."""
REACH_M = 0.06
"""No fruit is looked for further away than this."""
SIGMA_M_MIN = 0.002
SAG_M_PER_DAY = 0.006
"""Trusses sink and turn: what a day adds to the position's deviation."""
STIRRED_M, STIRRED_GATE = 0.02, 9.0
"""A truss that lost a fruit to a hand, or was pushed, hangs elsewhere: deviation of the place of what is missing while the
like of it has come up nearby; it has to be more alike than in the same place."""
BIAS_SIGMA_M = 0.006
"""A docked robot's own pose moves a whole scan by about this much."""
RADIUS_SIGMA_RATIO = 0.12
SHIFT_PAIRS_MIN = 4
"""So many fruit tell by how much the whole scan is off."""
AGAIN = 0.35
"""The same leaves and lights are seen again: each further look tells this part of what the first told."""
THERE_M = 0.03
"""A fruit hangs where it is said to when it is nearer than this; believed no more than its place is known."""
SEEN_PRIOR, UNSEEN_PRIOR = 0.5, 0.8
"""Of the chance to see a fruit from a direction, before anything is known: beta distribution."""
EYE_M = 0.06
"""Two views from nearer than this are one direction."""
EYES_MAX = 24
LONE_RATIO = 0.05
"""Of the circles of fruit, so few are the only one of a fruit that several views had in their pictures (counted with two
detectors: 0 of 70 and 2 of 130). False circles nearly all stand alone, so one view of several is weak evidence of a new
fruit, also where no other looks (few fruit hang there), and so is the edge of a single picture."""
ODDS_MISSED_MIN = -2.5
"""One scan alone does not count for more against a fruit: branches move."""
FLOOR = 0.20
"""Below this confidence a fruit leaves the inventory."""
TOUCH = 0.6
"""Two fruit nearer than this part of their radii's sum are one."""
GONE_SIGHT_MIN = 0.3
"""A fruit in doubt is gone when it was not seen from where it should have been with at least this chance."""
BLIND_SCANS_MAX = 3
MOVED_M = 0.02
"""So far an unreachable fruit has to move before it is tried again."""


@dataclass(frozen=True, slots=True)
class Left:
    """A fruit that left the inventory."""

    fruit_id: str
    why: str
    lost: Colour | None = None
    """Its colour when it hangs there no longer and nobody told of a pick; None when another entry stands for it."""


@dataclass(slots=True)
class Merged:
    """What a scan made of the inventory."""

    tracks: list[Track]
    new: list[str] = field(default_factory=list)
    left: list[Left] = field(default_factory=list)
    settled: dict[str, bool] = field(default_factory=dict)
    """Fruit that were in doubt: whether they still hang there."""


def merge(
    tracks: Sequence[Track],
    scan: Scan,
    pace: Pace,
    now_s: float,
    name: Callable[[], str],
    undecided: Collection[str] = (),
) -> Merged:
    """The inventory after a scan; `name` gives a new fruit's id. The caller keeps count of scan ids.

    `undecided` are fruit in doubt whose pick may still be under way: this scan does not settle them.
    """
    pairs = associate(tracks, scan.sightings, pace, now_s)
    stirred = _stirred(tracks, scan, pairs, pace, now_s)
    seen_by = {column: scan.sightings[row] for row, column in [*pairs.items(), *stirred.items()]}
    pairs |= stirred
    merged = Merged([])
    for i, track in enumerate(tracks):
        moved_m = STIRRED_M if i in stirred.values() else 0.0
        after = _found(track, seen_by[i], scan, moved_m, now_s) if i in seen_by else _missed(track, scan, tracks)
        if track.fruit.fruit_id in undecided:
            merged.tracks.append(after.with_fruit(in_doubt=True))
        else:
            _keep(track, after, seen=i in seen_by, merged=merged)
    found = [track for track in merged.tracks if track.fruit.last_seen_s == now_s]
    for row, sighting in enumerate(scan.sightings):
        if row not in pairs and not _repeats(sighting, found):
            track = _fresh(name(), sighting, scan, now_s)
            merged.new.append(track.fruit.fruit_id)
            merged.tracks.append(track)
    _unite(merged)
    colours = {track.fruit.fruit_id: track.belief(pace).colour(now_s) for track in merged.tracks}
    merged.tracks = [_ripened(track, colours[track.fruit.fruit_id], now_s) for track in merged.tracks]
    return merged


def associate(tracks: Sequence[Track], sightings: Sequence[Sighting], pace: Pace, now_s: float) -> dict[int, int]:
    """Which sighting (row) is which known fruit (column): the likeliest whole assignment within the gates.

    The scan as a whole may be off by the robot's pose: when enough fruit are known, their common shift is taken out first.
    """
    ready = [_Expected.of(track, pace, now_s) for track in tracks]
    pairs = assign(_costs(ready, sightings, (0.0, 0.0, 0.0)), len(sightings), GATE)
    if len(pairs) < SHIFT_PAIRS_MIN:
        return pairs
    shift = tuple(
        median(point(sightings[row])[axis] - ready[column].p[axis] for row, column in pairs.items()) for axis in range(3)
    )
    return assign(_costs(ready, sightings, (shift[0], shift[1], shift[2])), len(sightings), GATE)


def _stirred(tracks: Sequence[Track], scan: Scan, pairs: Mapping[int, int], pace: Pace, now_s: float) -> dict[int, int]:
    """Of what is left over: which sighting (row) is which fruit (column) that should have been seen where it hung."""
    known = set(pairs.values())
    lost = [
        i for i, t in enumerate(tracks) if i not in known and max(_sights(t, scan, tracks), default=0.0) >= GONE_SIGHT_MIN
    ]
    seen_at = [tracks[i] for i in known]
    come = [
        row for row, sighting in enumerate(scan.sightings)
        if row not in pairs and len(sighting.views) > 1 and not _repeats(sighting, seen_at)
    ]  # fmt: skip
    ready = [_Expected.of(tracks[i], pace, now_s, STIRRED_M) for i in lost]
    found = assign(_costs(ready, [scan.sightings[row] for row in come], (0.0, 0.0, 0.0)), len(come), STIRRED_GATE)
    return {come[row]: lost[column] for row, column in found.items()}


@dataclass(frozen=True, slots=True)
class _Expected:
    """A known fruit as it should look now."""

    p: tuple[float, float, float]
    var_m2: float
    radius_m: float
    colours: tuple[float, float, float]

    @classmethod
    def of(cls, track: Track, pace: Pace, now_s: float, moved_m: float = 0.0) -> _Expected:
        fruit, belief = track.fruit, track.belief(pace)
        radius_m = belief.radius_m(fruit.radius_m, fruit.last_seen_s, now_s)
        return cls(track.p, _aged_var(fruit, now_s) + moved_m**2 + BIAS_SIGMA_M**2, radius_m, belief.colours(now_s))


def _aged_var(fruit: Fruit, now_s: float) -> float:
    days = max(0.0, now_s - fruit.last_seen_s) / DAY_S
    return max(fruit.sigma_m, SIGMA_M_MIN) ** 2 + SAG_M_PER_DAY**2 * days


def _costs(
    known: Sequence[_Expected], sightings: Sequence[Sighting], shift: tuple[float, float, float]
) -> dict[tuple[int, int], float]:
    costs = {}
    for row, sighting in enumerate(sightings):
        p = tuple(a - b for a, b in zip(point(sighting), shift, strict=True))
        for column, fruit in enumerate(known):
            if abs(p[0] - fruit.p[0]) < REACH_M and (distance := math.dist(p, fruit.p)) < REACH_M:
                costs[row, column] = _cost(sighting, fruit, distance)
    return costs


def _cost(sighting: Sighting, fruit: _Expected, distance_m: float) -> float:
    cost = distance_m**2 / (fruit.var_m2 + max(sighting.sigma_m, SIGMA_M_MIN) ** 2)
    cost += (math.log(sighting.radius_m / fruit.radius_m) / (2.0 * RADIUS_SIGMA_RATIO)) ** 2
    said = COLOURS.index(sighting.colour)
    likely = sum(p * MISTAKE[true][said] for true, p in enumerate(fruit.colours))
    usual = max(MISTAKE[said])
    return cost - 2.0 * math.log(max(likely, 1e-6) / usual)


# Evidence


def _evidence(sighting: Sighting, detector: Accuracy) -> float:
    """Log-odds that a sighting is of a fruit: of several views the robot's word, which has weighed them; of a single one
    the detector's precision and its own word."""
    if len(sighting.views) > 1:
        return logit(sighting.confidence)
    return 0.5 * (logit(detector.precision) + logit(sighting.confidence))


def _further(track: Track, seen: Sighting, scan: Scan) -> float:
    """Log-odds that a sighting of a known fruit adds: seen as before, the same leaves and lights may deceive again."""
    evidence = _evidence(seen, scan.detector)
    if len(seen.views) == 1:
        return max(0.0, evidence)
    return evidence if _new_eye(track, seen, scan) else AGAIN * evidence


def _against(sights: Iterable[float], detector: Accuracy) -> float:
    """Log-odds (negative) of a fruit that was not detected by views each of which had such a chance to see it."""
    odds = sorted(math.log(1.0 - detector.recall * sight) for sight in sights)
    if not odds:
        return 0.0
    return max(ODDS_MISSED_MIN, odds[0] + AGAIN * sum(odds[1:]))


def _sights(track: Track, scan: Scan, others: Sequence[Track]) -> list[float]:
    """For each view that had the fruit in its picture: the chance that nothing was in between."""
    chances = []
    for view in scan.views:
        eye = _eye(track.eyes, view)
        if _shows(view, track.p, eye) and not blocked(view, track, others):
            seen, looks = (eye.seen, eye.looks) if eye is not None else (0, 0)
            chances.append((SEEN_PRIOR + seen) / (SEEN_PRIOR + UNSEEN_PRIOR + looks))
    return chances


def _shows(view: View, p: tuple[float, float, float], eye: Eye | None) -> bool:
    """Whether it should be in the picture: well inside, or at its edge where it was seen from here before."""
    return in_view(view, p) or (eye is not None and eye.seen > 0)


def _eye(eyes: Sequence[Eye], view: View) -> Eye | None:
    """The direction remembered that is this view's."""
    near = [eye for eye in eyes if math.dist(eye.place.p, point(view)) < EYE_M]
    return min(near, key=lambda eye: math.dist(eye.place.p, point(view)), default=None)


def _looked(track: Track, views: Sequence[View], seen_in: Sequence[int]) -> list[Eye]:
    """The directions after a scan that saw the fruit in some views and not in others."""
    eyes = list(track.eyes)
    for index, view in enumerate(views):
        eye = _eye(eyes, view)
        if index not in seen_in and not _shows(view, track.p, eye):
            continue
        seen = int(index in seen_in)
        if eye is None:
            eyes.append(Eye(place=Place(x_m=view.x_m, y_m=view.y_m, z_m=view.z_m), looks=1, seen=seen))
        else:
            eyes[eyes.index(eye)] = eye.model_copy(update={"looks": eye.looks + 1, "seen": eye.seen + seen})
    return eyes[-EYES_MAX:]


# One fruit


def _found(track: Track, seen: Sighting, scan: Scan, moved_m: float, now_s: float) -> Track:
    fruit = track.fruit
    var, new_var = _aged_var(fruit, now_s) + moved_m**2, max(seen.sigma_m, SIGMA_M_MIN) ** 2 + BIAS_SIGMA_M**2
    trust = var / (var + new_var)
    moved = {
        axis: getattr(fruit, axis) + trust * (getattr(seen, axis) - getattr(fruit, axis)) for axis in ("x_m", "y_m", "z_m")
    }
    # The same view again guesses the same distance: it makes the place no surer.
    sigma_m = math.sqrt(var * (1.0 - trust)) if _from_elsewhere(track, seen, scan) else min(fruit.sigma_m, seen.sigma_m)
    odds = logit(fruit.confidence) + _further(track, seen, scan)
    trust_radius = 1.0 / (1.0 + min(4, fruit.seen_count))
    after = track.with_fruit(
        **moved,
        sigma_m=max(SIGMA_M_MIN, sigma_m),
        radius_m=fruit.radius_m + trust_radius * (seen.radius_m - fruit.radius_m),
        ripeness=seen.ripeness if seen.ripeness is not None else fruit.ripeness,
        confidence=min(probability(odds), _there(sigma_m)),
        robot_pose=seen.robot_pose,
        image_x_px=seen.image_x_px,
        image_y_px=seen.image_y_px,
        last_seen_s=now_s,
        seen_count=fruit.seen_count + 1,
        missed_count=0,
        failed="",
        in_doubt=False,
    )
    observed = Observation(t_s=now_s, colour=seen.colour, radius_m=seen.radius_m, ripeness=seen.ripeness)
    eyes = _looked(after, scan.views, seen.views)
    return _try_again(after.model_copy(update={"seen": remember(track.seen, observed), "eyes": eyes, "blind_scans": 0}))


def _there(sigma_m: float) -> float:
    """The chance that a fruit whose place is known so well is within `THERE_M` of it, along the least known direction."""
    return math.erf(THERE_M / (max(sigma_m, SIGMA_M_MIN) * math.sqrt(2.0)))


def _from_elsewhere(track: Track, seen: Sighting, scan: Scan) -> bool:
    """Whether a view shows it that did not before, or several do at once."""
    return len(seen.views) > 1 or _new_eye(track, seen, scan)


def _new_eye(track: Track, seen: Sighting, scan: Scan) -> bool:
    eyes = [_eye(track.eyes, scan.views[index]) for index in seen.views if index < len(scan.views)]
    return any(eye is None or eye.seen == 0 for eye in eyes)


def _try_again(track: Track) -> Track:
    """A fruit that could not be reached where it hung may be reached where it hangs now."""
    if track.fruit.unreachable and track.marked_at is not None and math.dist(track.p, track.marked_at.p) > MOVED_M:
        return track.with_fruit(unreachable="").model_copy(update={"marked_at": None})
    return track


def _missed(track: Track, scan: Scan, others: Sequence[Track]) -> Track:
    sights = _sights(track, scan, others)
    if not sights:
        return track.model_copy(update={"blind_scans": track.blind_scans + 1}) if track.fruit.in_doubt else track
    if track.fruit.in_doubt and max(sights) < GONE_SIGHT_MIN:
        track = track.model_copy(update={"blind_scans": track.blind_scans + 1})
    odds = logit(track.fruit.confidence) + _against(sights, scan.detector)
    should = max(sights) >= GONE_SIGHT_MIN
    return track.with_fruit(confidence=probability(odds), missed_count=track.fruit.missed_count + int(should))


def _keep(before: Track, after: Track, *, seen: bool, merged: Merged) -> None:
    """On, unless it is gone."""
    fruit = before.fruit
    if fruit.in_doubt:
        gone = after.fruit.missed_count > fruit.missed_count or after.blind_scans >= BLIND_SCANS_MAX
        if seen or gone:
            merged.settled[fruit.fruit_id] = seen
        if gone and not seen:
            merged.left.append(
                Left(fruit.fruit_id, "a pick was permitted, and a scan does not see it any more", fruit.colour)
            )
            return
    if after.fruit.confidence < FLOOR and not after.fruit.in_doubt:
        merged.left.append(Left(fruit.fruit_id, f"not seen any more: confidence {after.fruit.confidence:.2f}", fruit.colour))
        return
    merged.tracks.append(after)


def _fresh(fruit_id: str, sighting: Sighting, scan: Scan, now_s: float) -> Track:
    fruit = Fruit(
        fruit_id=fruit_id, first_seen_s=now_s, last_seen_s=now_s, seen_count=1,
        **sighting.model_dump(exclude={"views", "robot_pose"}), robot_pose=sighting.robot_pose,
    )  # fmt: skip
    track = Track.of(fruit)
    odds = _evidence(sighting, scan.detector)
    if len(sighting.views) == 1:
        unseen = [view for index, view in enumerate(scan.views) if index not in sighting.views and in_view(view, track.p)]
        chance = SEEN_PRIOR / (SEEN_PRIOR + UNSEEN_PRIOR)
        odds += _against([chance] * len(unseen), scan.detector)
        if len(scan.views) > 1 or not in_view(scan.views[sighting.views[0]], track.p):
            odds += math.log(LONE_RATIO)
    eyes = _looked(track, scan.views, sighting.views)
    confidence = min(probability(odds), _there(sighting.sigma_m))
    return track.with_fruit(confidence=confidence).model_copy(update={"eyes": eyes})


def _ripened(track: Track, colour: str, now_s: float) -> Track:
    since_s = track.ripe_since_s
    if colour != "red":
        since_s = None
    elif since_s is None:
        since_s = now_s
    return track.with_fruit(colour=colour).model_copy(update={"ripe_since_s": since_s})


# Doubles


def _repeats(sighting: Sighting, found: Sequence[Track]) -> bool:
    """The robot told one fruit twice: it overlaps one that this very scan has seen."""
    return any(math.dist(point(sighting), t.p) < TOUCH * (sighting.radius_m + t.fruit.radius_m) for t in found)


def _unite(merged: Merged) -> None:
    """Entries that overlap are one fruit: the older keeps its name, the surer its place."""
    kept: list[Track] = []
    for track in merged.tracks:
        twin = next((i for i, other in enumerate(kept) if _overlap(other, track)), None)
        if twin is None:
            kept.append(track)
            continue
        older = kept[twin]
        kept[twin] = _one_of(older, track)
        merged.left.append(Left(track.fruit.fruit_id, f"one and the same as {older.fruit.fruit_id}"))
        merged.new = [name for name in merged.new if name != track.fruit.fruit_id]
        if track.fruit.fruit_id in merged.settled:
            merged.settled[track.fruit.fruit_id] = True
    merged.tracks = kept


def _overlap(a: Track, b: Track) -> bool:
    return math.dist(a.p, b.p) < TOUCH * (a.fruit.radius_m + b.fruit.radius_m)


def _one_of(older: Track, younger: Track) -> Track:
    surer = max(older, younger, key=lambda track: (track.fruit.confidence, -track.fruit.sigma_m))
    return surer.with_fruit(
        fruit_id=older.fruit.fruit_id,
        first_seen_s=min(older.fruit.first_seen_s, younger.fruit.first_seen_s),
        last_seen_s=max(older.fruit.last_seen_s, younger.fruit.last_seen_s),
        seen_count=max(older.fruit.seen_count, younger.fruit.seen_count),
        in_doubt=older.fruit.in_doubt or younger.fruit.in_doubt,
    ).model_copy(update={"ripe_since_s": older.ripe_since_s or younger.ripe_since_s})
