"""Reasons why rows miss their bars, written by people. Each reason holds for one value. docs/decisions has the experiments."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

#: Relative difference beyond which a value has changed. One query of 3,130 makes a larger difference. So values have five figures.
TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a row misses its bar.

    Attributes:
        explains: value of the row that the reason explains, with five figures or more. It does not hold for other values.
        text: for readers of the report.
    """

    explains: float | None
    text: str

    def fits(self, value: float | None) -> bool:
        """Return whether the reason holds for a value.

        Args:
            value: value of the row; None if absent.
        """
        if value is None or self.explains is None:
            return value is self.explains
        return math.isclose(value, self.explains, rel_tol=TOLERANCE)


def explain(rows: Iterable[dict[str, Any]], reasons: Mapping[str, Reason] | None = None) -> None:
    """Add a ``reason`` to every row that misses its bar, and remove it from rows that hold.

    ``reason`` has the value that it ``explains`` and a ``text``. If the value of the row has changed, it has ``outdated`` instead
    of the text.

    Args:
        rows: rows of a report, changed in place.
        reasons: reasons by row id; None for ``WHY_MISSED``.
    """
    reasons = WHY_MISSED if reasons is None else reasons
    for row in rows:
        row.pop("reason", None)
        reason = reasons.get(row["id"])
        if reason is None or row.get("holds", True):
            continue
        content = {"text": reason.text} if reason.fits(row["value"]) else {"outdated": True}
        row["reason"] = {"explains": reason.explains} | content


_BORDERS = (
    "Of 80 wrong streets, 32 answers are within 5 m of the truth, but across a street border (2 within 1 m). The other errors "
    "are perceptual aliases. Another temperature of the vote changed nothing. Using the street of the heaviest cluster instead "
    "of the vote gained half a point in four other cities, and nothing here"
)
_HEIGHTS = (
    "Confidence causes about half of the losses: forced answers within 1 m are 0.94, 0.945, 0.965, 0.98, 0.99 and 0.99 from 0.2 to 3.5 m. "
    "At 0.4 m 3 of 200 are accepted and wrong, at 0.8 and 1.5 m one each, elsewhere none. Cameras at 0.25, 0.4 and 3.4 m in the "
    "calibration (decision 0201) and the verifier (decision 0204) together raised the accepted answers within 1 m from 0.86 to 0.895 at "
    "0.2 m, and from 0.89 to 0.96 at 3.5 m. Tried before: training on cameras of 0.3 to 3.2 m (decision 0154; forced at 0.2 m 0.815 -> "
    "0.93), depth structure and confirmation (decisions 0159 and 0165; accepted at 0.2 m 0.775 -> 0.88), a larger encoder (decision 0174; "
    "accepted at 0.8 m 0.915 -> 0.93, at 3.5 m 0.93 -> 0.90). A given height gains nothing, because the estimate errs by 0.02 to 0.04 m"
)
_OVER_BARE = (
    "Medians of runs differ by up to 20 %: full REST 0.95 to 1.13, retrieval REST 1.14 to 1.27, retrieval gRPC 1.14 to 1.39. With one "
    "client, full REST has 1.15 and retrieval REST 1.72. The bare pipeline takes 104 ms for a full request in this run, and 29 ms in "
    "earlier runs, on another machine and with fewer stages (decision 0186). "
    "In those runs the event loop took 1.0 ms of a request, splitting the body 0.12 to 0.2 ms, writing "
    "the answer 0.12 to 0.28 ms, and the dispatch of the framework 0.1 ms. These changes gained nothing: httptools and uvloop, fewer "
    "copies, no proxy headers, bodies that the system delivers in one piece, other intervals of thread switches and of garbage "
    "collection, one arena of malloc. Parsing the headers of all parts in one step gained 0.1 ms. Answers cannot be computed in the "
    "thread of the event loop, because a stuck request would block all others. Next step: fewer reads of a body. Each read wakes the "
    "event loop while the worker computes"
)
_CONFIDENCE_0013 = (
    "23 of the 24 forced answers are within 1 m, and 6 of these are refused. No accepted answer is wrong. Before the verifier of decision "
    "0204 and other changes (0201 to 0203) they were 22 and 8. Before decisions 0176 to 0180 (aligned rows, depth above the survey "
    "omitted, restarts), 12 were refused. In the simulator most refused right answers of cars are those where retrieval prefers another "
    "place (decision 0175). On this drive retrieval alone finds 0.67 of the places within 5 m, and registration the rest. The street has "
    "trees, hedges and parked cars instead of facades. The drive serves reports only, so we did not look at its features. Five frames "
    "accept all answers, a track accepts 0.96, and a prior of 3 m accepts 22, all right. Tried: less weight of retrieval (0175), depth "
    "structure (0159), poses further along the street (0165), a larger encoder (0174)"
)
_PEERS = (
    "The best peer is MLServer. With eight clients its processor time is 35.3 ms for a full request and 10.0 ms for retrieval. "
    "Ours is 38.2 and 11.6 ms. The others take 39.5 to 40.4 and 11.7 to 13.2 ms. The handler of MLServer runs in the thread of "
    "the event loop, as its documentation recommends without workers. So it switches no thread. Our service hands work to "
    "another thread. So it answers health checks and refusals meanwhile, and a stuck request blocks no other request. We "
    "assume that the thread switch causes the difference. We did not measure it"
)
WHY_MISSED: dict[str, Reason] = {
    "raw.unseen.precise.recall_at_1_5m": Reason(
        0.5688623,
        "Queries are levelled and sent at three headings, as for our method. With the straight heading only, as in the "
        "prototype (0.29), the raw image has the recall of raw.unseen.precise.straight. Cities of 600 x 400 m do not reach the "
        "bar either (raw.large 0.46, ours 0.987). There, four hard conditions would miss their bars",
    ),
    "retrieval.paper_city.precise.recall_at_10_5m": Reason(
        0.9974441,
        "8 of 3,130 queries have no view of their place among the ten nearest places (10 with the encoder before). 24 of the 32 queries "
        "whose first place is wrong have their place among the ten. Tried: random rigs (decision 0154), a GPU (0167), small cities (0171), "
        "a larger encoder (0174)",
    ),
    "full.unseen.precise.within_0_5_m": Reason(
        0.9923333333333333,
        "12 of 3,000 queries have a forced error above 1 m, 4 of these above 5 m. 10 answers are refused, 1 of them right. 10 accepted "
        "answers are between 0.5 and 1 m off, and 3 between 1 and 1.5 m. None is farther off. The verifier of decision 0204 raised the "
        "value from 0.986 to 0.991. Tried before it: comparison with poses further along the street (decision 0165), a larger encoder "
        "(decision 0174), brightness around the answer (decision 0181: it misleads on real images)",
    ),
    "full.unseen.stereo.within_1_m": Reason(
        0.9703333333333334,
        "50 of 3,000 queries have a forced error above 1 m, 15 of these above 5 m. 79 answers are refused, and 39 of these are right: a "
        "LOCALIZED answer needs a confidence of 0.9, and 27 of the 39 have 0.65 to 0.9. 10 accepted answers are wrong (0.3 %), by 1 to "
        "2.1 m. Decision 0165 raised the value from 0.936 to 0.947, the encoder of decision 0174 to 0.952, evidence along the rays to "
        "0.955 (0202), the verifier to 0.970 (0204). Tried: other models, 60 numbers of the image (decision 0165), rivals without "
        "similarity (decision 0181)",
    ),
    "full.paper_city.precise.street_accuracy": Reason(
        0.9923323,
        "18 of 3,130 answers are refused, 9 of them right: an answer needs a confidence of 0.9 since decision 0149. 6 accepted answers "
        "are across a street border. No accepted answer is more than 1 m off. In the run of 29 November, before the verifier (decision "
        "0204), the value was 0.985. Tried before: similarity at the pose and halves of the image (decision 0168)",
    ),
    "full.paper_city.precise.mean_distance_error_m": Reason(
        0.0543181,
        "No accepted answer is more than 1 m off. The errors of the survey's poses, 0.03 m for each axis, are most of the mean (decision "
        "0094)",
    ),
    "full.paper_city.precise.forced_mean_distance_error_m": Reason(
        0.2196274,
        "5 answers are more than 5 m off, by 100 m on average. They contribute 0.16 m to the mean. All of them are refused. In the run of "
        "29 November, before the verifier (decision 0204), they were 6, by 71 m on average, and the mean was 0.197 m",
    ),
    "full.paper_city.stereo.street_accuracy": Reason(
        0.9575080,
        "126 of 3,130 answers are refused, 71 of them right. 7 accepted answers are more than 1 m off, 5 of these by less than 1.6 m. In "
        "the run of 29 November, before the verifier (decision 0204), 201 were refused and the value was 0.934. Tried before: 60 numbers "
        "(decision 0165), similarity at the pose and halves of the image (decision 0168), a larger encoder (0174)",
    ),
    "doubt.covariance_95_coverage": Reason(
        0.8908603950451959,
        "The worst of four figures: the position with precise depth. The full pose has 0.901 with precise and 0.900 with stereo depth "
        "(0.881 and 0.858 before decision 0179). Restarts widen the covariance along the street more often than needed, so too many "
        "errors are smaller than the lower limit. Tried before: figures of the query, the spread of nearby candidates, and factors by "
        "axis from three calibration cities. Also tried: a scale from the confidence features, constant errors of the map (decision "
        "0160), and a jackknife over the image (decision 0179)",
    ),
    "doubt.sigma_coverage_gap": Reason(
        0.18174723803146964,
        "The worst case is the position along the street with precise depth. Too many errors are within one standard deviation, because "
        "the spread of restarts covers a second minimum that most answers do not have (decision 0179). With stereo depth the gap fell "
        "from 0.129 to 0.089. Tried: restarts weighted by their cost, without the farthest, and powers of their spread change the "
        "consistent share by 0.005 at most, because all ends have the same cost within its noise (decision 0201)",
    ),
    "height.0.2.within_1_m": Reason(0.895, _HEIGHTS),
    "height.0.2.given.within_1_m": Reason(0.9, _HEIGHTS),
    "height.0.4.within_1_m": Reason(0.92, _HEIGHTS),
    "height.0.4.given.within_1_m": Reason(0.925, _HEIGHTS),
    "height.0.8.within_1_m": Reason(0.945, _HEIGHTS),
    "height.0.8.given.within_1_m": Reason(0.93, _HEIGHTS),
    "height.1.5.given.within_1_m": Reason(0.965, _HEIGHTS),
    "height.2.5.given.within_1_m": Reason(0.955, _HEIGHTS),
    "height.3.5.given.within_1_m": Reason(0.96, _HEIGHTS),
    "real.kitti_0013.answered_within_1_m": Reason(0.7083333, _CONFIDENCE_0013),
    "real.calibrated_on_0005.right_but_refused": Reason(
        0.3333333,
        "With the calibration of drive 0005, 8 of the 23 right answers are refused, without it 6. " + _CONFIDENCE_0013,
    ),
    "real.kitti_0005.sigma_coverage_gap": Reason(
        0.2016154,
        "The direction across the street has the largest gap: 23 of 26 errors are within one standard deviation. With 26 answers this "
        "share has a standard error of 0.09, and the worst of several directions counts. So the gap may be chance, but drive 0013 has the "
        "same sign",
    ),
    "real.kitti_0013.sigma_coverage_gap": Reason(
        0.317,
        "The covariance of heights is too wide here: all 23 errors are within one standard deviation. A possible cause is that map and "
        "queries are of the same traversal, so both share the survey's error of height. We did not examine it",
    ),
    "real.kitti_0013.covariance_95_coverage": Reason(
        0.8260870,
        "19 of 23 errors are consistent, and the bar needs 21. Only one error lies outside of the 95 % ellipsoid. So three are smaller "
        "than the covariance says",
    ),
    **dict.fromkeys(
        ("real.matcher.error_ratio", "real.matcher.error_ratio.textured.percentile_90"),
        Reason(
            1.2812920,
            "The import now aligns the rows of real pairs and matches with a prefilter (decision 0176), so the real errors fell from "
            "1.96 to 1.73 px. The simulated robots keep rows that are not aligned, because their row errors stand for other real "
            "errors too: with aligned rows the four ratios were 0.60 to 0.93",
        ),
    ),
    "real.kitti_stereo.registration.median_m": Reason(
        0.0829505,
        "The median was 0.074 m at first, and 0.081 m before rows were aligned and depth above the survey was omitted. Since the first, "
        "the noise of a stereo rig is at least half a pixel, and the left tenth of the images is matched too. We did not measure which of "
        "them costs 9 mm. These seven frames must not decide a setting",
    ),
    "kitti_drive.odometry_vs_reference_m": Reason(
        0.1110862,
        "The reference is wrong by 0.36 m in its first 0.4 s. GICP of these two scans gives 0.96 to 0.97 m for a reference "
        "step of 0.61 m. We tried three starts, and points at the sides, behind, or all. Without the first frame (next row) "
        "the value is 0.072 m. The rest is unexplained. Tried: KISS-ICP alone (0.40 m), alignment on distributions, only "
        "points above 1 to 4.5 m",
    ),
    "roundtrip.kitti.pose_difference_m": Reason(
        0.0628671,
        "The value is the largest of 40 differences. Depth in KITTI's format has steps of 3.9 mm. Such a step can change a "
        "close decision of registration. Earlier runs had 0.039 to 0.133 m. In the run with 0.047 m the median was 0.9 mm, and 5 "
        "differences exceeded 1 cm. No answer was worse",
    ),
    "cpu_over_bare.retrieval.rest": Reason(1.1627534, _OVER_BARE),
    "cpu_over_bare.retrieval.grpc": Reason(1.3852308, _OVER_BARE),
    "retrieval.cpu_ms_fast_depth": Reason(
        13.5869565,
        "The bare pipeline alone takes 11.9 ms with PNG in this run (9.1 ms in the run before, on another machine and with a smaller "
        "encoder). Depth takes 1.8 ms as PNG and 0.5 ms as raw16+lz4, so depth can save no more",
    ),
    "retrieval.p99_over_p50": Reason(
        4.9267891,
        "At 70 % of the load that saturates one worker, random arrivals alone give 4.3 with a constant service time (M/D/1 "
        "queue, simulated). Earlier runs had 3.8 and 4.4. A ratio of 3 needs a load below 60 %, or a second worker",
    ),
    "peers.throughput_over_best.retrieval": Reason(0.9103448, _PEERS),
    "peers.throughput_over_best.full": Reason(0.9624060, _PEERS),
    "peers.p99_under_best": Reason(
        1.0082593,
        "The median of three rounds is less than 1 % above that of the best peer. Latencies of single rounds differ by more",
    ),
    "request.files_before_engine": Reason(
        7.0,
        "The seven files are HTTP protocol, host and key, route, body, memory and queue, fields, conversion. Each has one task, and none "
        "only passes things on. The HTTP protocol counts because the measured request uses a socket. Tried: the request id joined the "
        "fields (8 to 7). A sixth file would merge two tasks, or take the camera checks out of the schema that the client uses too",
    ),
    "request.files_in_core": Reason(
        57,
        "The count includes every file whose functions one request calls. 12 decode, level and fuse images, 6 retrieve, 7 register, 9 "
        "score, 4 decide, 5 compare frames and build the answer, 5 read the map, 2 are geometry, 7 belong to the engine. Tried: packages "
        "by stage with small files joined (56 to 53; depth structure, confirmation, agreement and restarts are four more). The others "
        "have readers of their own or several users. 20 files would hold several subjects each",
    ),
}

WHY_MISSED["full.condition.sideways.within_1_m"] = Reason(
    0.94,
    "Confidence causes the loss: 488 of 500 forced answers are within 1 m (484 with the encoder before), and 18 of these are refused. One "
    "accepted answer is wrong. The default needs a confidence of 0.9 since decision 0149",
)
WHY_MISSED["full.condition.depth_15m_sequence5.within_1_m"] = Reason(
    0.9666666666666667,
    "Confidence causes the loss: all 300 forced answers are within 1 m, and 10 are refused. None is wrong. The default needs a confidence "
    "of 0.9 since decision 0149",
)
WHY_MISSED["sequence.landmark.within_1_m"] = Reason(
    0.875,
    "All 72 forced answers are within 1 m, and 63 are accepted (50 before the confidence knew the number of frames, decision 0203). "
    "None of the 137 sequences without a landmark is accepted and wrong. The repeating street is a family of the calibration: half of "
    "its single answers are wrong, so equal blocks lower the confidence. Tried: encoders (0154, 0171 and 0174), depth structure (0159), "
    "frames that confirm each other (0169). Next: a feature that tells a landmark from a repeated block",
)
WHY_MISSED["rigs.worst_ece"] = Reason(
    0.17314814814814813,
    "The worst family are the sparse rings of a spinning LiDAR. No fit contains them, and the service refuses their answers as out of "
    "range. Of these answers 0.37 are right. Among the fitted families the worst is the D435 with 0.042 (rigs.worst_fitted_ece; 0.071 "
    "before the verifier, decision 0204). See rigs.rings.ece",
)
WHY_MISSED["rigs.worst_covariance_95_coverage"] = Reason(
    0.6363636363636364,
    "Monocular depth, whose scale errs by 8 %: it errs in height, and no number of the query shows it. See "
    "rigs.monocular.covariance_95_coverage; without it the worst is the Kinect",
)
WHY_MISSED["rigs.worst_sigma_coverage_gap"] = Reason(
    0.3453376623376624, "Monocular depth, upwards, for the same reason as rigs.worst_covariance_95_coverage"
)
WHY_MISSED["rigs.worst_within_1_m"] = Reason(
    0.198,
    "The worst family is the OAK-D with semi-global matching, 0.5 m above the ground: at 33 px m an error of 0.25 px is 0.8 m at 10 m. "
    "Training on random rigs raised it from 0.03 to 0.15 (decision 0154), the larger encoder to 0.20 (0174), and with restarts and "
    "the verifier it is 0.20 (0179, 0204). Of the rigs that the calibration is fitted to, the D435 has the least (0.68)",
)
WHY_MISSED["search.ms_at_100_times_the_town"] = Reason(
    2.8260910,
    "A search takes 21.4 ms, and a scan of the town 7.6 ms. It reads 1,397 of the lists to reach a recall of 0.993. The first form of "
    "decision 0184 took 18.8 ms and had 0.985, and other work slowed the scan of the town to 10.1 ms in that run. So its ratio of 1.87 was "
    "too good. Tried: more bits per axis, PQ, other numbers of axes and places, votes (decision 0184). Next step: fewer lists with more "
    "views around those that they find",
)
WHY_MISSED["town.build_minutes"] = Reason(
    18.25290102270001,
    "Machines of this benchmark differ: builds before took 14.7 and 16.9 minutes on two others. Side by side, a large tile takes 423 "
    "s of processor time now and 451 s before decision 0199, because ten tiles read 29,457 instead of 36,301 scans. A small tile took "
    "37 s of processor time before decision 0200, and 36 to 39 s after it. The two cores share caches and memory, so two tiles at "
    "once take a third longer than one alone. The encoder takes a third of a tile, views and levels of scans 15 %, the vote 11 % "
    "(decision 0197). Tried: scans up to 60 m beyond a tile, other batches of the encoder. Next step: an encoder without the planes "
    "of queries (2 to 4 %), and tiles that read the sums of scans which another tile has gathered",
)
WHY_MISSED["town.ready_s"] = Reason(
    2.5757566609991045,
    "Runs on three machines had 2.4 to 2.6 s. Most of it is processor time of one Python process: imports take two fifths, and the "
    "tiles of the first query as much. Tried: no HTTP client in the service (112 of 1,144 modules less), tiles that open side by "
    "side, and decision 0198: no garbage collection during imports and one copy of the streets save 0.37 s; hashes in threads beside "
    "the imports, and a first query in one tile, do not help. Smaller tiles (decision 0199) save 0.2 s. Next step: a first query that "
    "opens fewer tiles without a slower second one",
)
WHY_MISSED["town.stereo.within_1_m"] = Reason(
    0.95,
    "Of the 25 lost answers 11 are right and refused, and one is accepted and 1.35 m off. Decision 0185 has the stages that lose the "
    "others. In the run of 29 November, before the verifier (decision 0204), the value was 0.918, and 25 right answers were refused. With "
    "a prior of 50 m the value is 0.974",
)
WHY_MISSED["town.sequence5.stereo.within_1_m"] = Reason(
    0.98,
    "2 of 100 sequences are hundreds of metres off and refused. All others are accepted and right. Decision 0165 raised the value from "
    "0.88 to 0.94, frames that confirm each other to 0.95 (0169). The run of 29 November had 0.97",
)
WHY_MISSED["train.two_process_loss_gap"] = Reason(
    0.05326234099074938,
    "Rounding. One process with two threads instead of one changes only the order of sums, and its loss differs more (0.073). Over 10 "
    "steps the difference is 0.018, that of rounding 0.026. At a rate of 0.001 two processes differ by 0.00003 (decision 0156)",
)
#: Why rows ``rigs.FAMILY.*`` miss their bars, by the last part of the id.
_RIGS = {
    "ece": (
        "No answer of the sparse rings lies in the range of a fit, so all are refused, and 0.37 are right. Half of the places between "
        "repeating blocks cannot be told apart. All other families hold the bar: the last two were the D435 (0.071) and monocular depth "
        "(0.069), before the verifier (decision 0204) lowered them to 0.042 and 0.016"
    ),
    "within_1_m": (
        "Retrieval loses most answers of small robots, D435 and Kinect, which see little. Registration ends 1 to 4 m beside the right "
        "pose for a fifth of the answers of ZED 2 and monocular depth, whose depth does not know better (decision 0181). Tried: training "
        "on random rigs (decision 0154; ZED 2 0.58 -> 0.69, D435 0.46 -> 0.62, robot 0.79 -> 0.83), a larger encoder (decision 0174; car "
        "0.92 -> 0.95, ZED 2 0.71, D435 0.68, robot 0.84), more starts, more states to the end, 48 hypotheses, weights of the support, "
        "the surveyed height (decision 0177), brightness (decision 0181). All answers of four cameras are within 1 m, and five frames "
        "find nearly all places of the cars and the robot"
    ),
    "right_but_refused": (
        "A LOCALIZED answer needs a confidence of 0.9, with every second query from outside the map. A rate of 0.02 accepts most of these "
        "answers. All answers of ZED 2 are refused because their noise lies outside the range of the other families. The shipped "
        "calibration contains this family, and gives 0.58 of its answers a confidence of 0.9 (in-sample). Tried: 12 sets of features, "
        "products, brightness (decision 0149), the encoder of decision 0154, depth structure (decision 0159: car 0.27 -> 0.19, robot 0.30 "
        "-> 0.24), poses further along the street (decision 0165: car 0.13, robot 0.21), places that registration has rejected (decision "
        "0176), the surveyed height (decision 0177: car 0.11), restarts (0179: car 0.08), evidence along the rays (0201), the verifier "
        "(0204: car 0.086 -> 0.066, robot 0.256 -> 0.133, D435 0.406 -> 0.278, monocular 0.414 -> 0.216). Next: a verifier of more cities"
    ),
    "wrong_of_localized": (
        "Few answers are wrong: OAK-D 5 of 27, monocular depth 9 of 290, repeating blocks 20 of 175. Without the OAK-D the fit knows no "
        "depth with such a small baseline. Blocks that are alike fool the depth structure (decision 0159), the evidence along the rays "
        "(0201) and the verifier (0204: 9 of 144 before it). The shipped calibration contains these blocks, and none of its 130 answers "
        "there with a confidence of 0.9 is wrong (in-sample). Of monocular depth 9 of 293 are, because its scale errs by 8 %"
    ),
    "covariance_95_coverage": (
        "The interval has two sides. The ellipsoid of 95 % contains 0.93 to 0.97 of the errors of most rigs, but 4 to 10 % of the errors "
        "are smaller than the lower limit (expected: 2.5 %): restarts widen the covariance along the street more often than needed. Depth "
        "with a scale error of 8 % (monocular) errs in height, which no number of the query shows. Kinect and iPhone have few pixels. "
        "Decisions 0151 and 0157 added survey and rectification, decision 0179 the spread of restarts and the misfit (mean 0.77 to 0.85). "
        "Tried: constant errors of the map (0160), a jackknife over the image, restarts of the points, more confidence features (0179)"
    ),
    "sigma_coverage_gap": (
        "The axis stands beside the figure. Along the street the covariance is too large for most answers, because it covers the second "
        "minimum of a few (decision 0179). Up it is too large where the survey is better than stated, and too small for monocular depth, "
        "whose scale errs by 8 %"
    ),
}
#: Values of these rows.
_RIG_VALUES = {
    "rigs.bus.covariance_95_coverage": 0.8975409836065574,
    "rigs.bus.sigma_coverage_gap": 0.1756065573770491,
    "rigs.car.right_but_refused": 0.066,
    "rigs.car.sigma_coverage_gap": 0.13158333333333327,
    "rigs.car.within_1_m": 0.96,
    "rigs.car_sparse.covariance_95_coverage": 0.8907216494845361,
    "rigs.car_sparse.right_but_refused": 0.082,
    "rigs.car_sparse.sigma_coverage_gap": 0.22834020618556694,
    "rigs.courier.covariance_95_coverage": 0.7526427061310782,
    "rigs.courier.sigma_coverage_gap": 0.1922642706131078,
    "rigs.courier.within_1_m": 0.946,
    "rigs.d435.covariance_95_coverage": 0.841642228739003,
    "rigs.d435.right_but_refused": 0.278,
    "rigs.d435.sigma_coverage_gap": 0.1967653958944281,
    "rigs.d435.within_1_m": 0.682,
    "rigs.d455.covariance_95_coverage": 0.8973305954825462,
    "rigs.d455.sigma_coverage_gap": 0.1732628336755646,
    "rigs.every_10_m.covariance_95_coverage": 0.8979591836734694,
    "rigs.every_10_m.sigma_coverage_gap": 0.13740816326530603,
    "rigs.four_cameras.covariance_95_coverage": 0.884,
    "rigs.four_cameras.sigma_coverage_gap": 0.22299999999999998,
    "rigs.iphone.covariance_95_coverage": 0.7142857142857143,
    "rigs.iphone.right_but_refused": 0.084,
    "rigs.iphone.sigma_coverage_gap": 0.19795238095238088,
    "rigs.iphone.within_1_m": 0.084,
    "rigs.kinect.covariance_95_coverage": 0.7272727272727273,
    "rigs.kinect.right_but_refused": 0.264,
    "rigs.kinect.sigma_coverage_gap": 0.14275757575757575,
    "rigs.kinect.within_1_m": 0.264,
    "rigs.livox.covariance_95_coverage": 0.8621399176954733,
    "rigs.livox.sigma_coverage_gap": 0.11535390946502055,
    "rigs.lorry.covariance_95_coverage": 0.859504132231405,
    "rigs.lorry.sigma_coverage_gap": 0.05460330578512396,
    "rigs.lorry.within_1_m": 0.968,
    "rigs.monocular.covariance_95_coverage": 0.6363636363636364,
    "rigs.monocular.right_but_refused": 0.216,
    "rigs.monocular.sigma_coverage_gap": 0.3453376623376624,
    "rigs.monocular.within_1_m": 0.778,
    "rigs.monocular.wrong_of_localized": 0.03103448275862069,
    "rigs.narrow.covariance_95_coverage": 0.8873239436619719,
    "rigs.narrow.sigma_coverage_gap": 0.09548911651728553,
    "rigs.oak_d.covariance_95_coverage": 0.8585858585858586,
    "rigs.oak_d.right_but_refused": 0.154,
    "rigs.oak_d.sigma_coverage_gap": 0.1553838383838383,
    "rigs.oak_d.within_1_m": 0.198,
    "rigs.oak_d.wrong_of_localized": 0.18518518518518517,
    "rigs.precise.covariance_95_coverage": 0.859253499222395,
    "rigs.precise.sigma_coverage_gap": 0.19180559875583203,
    "rigs.precise.within_1_m": 0.9407461594732992,
    "rigs.quadruped.covariance_95_coverage": 0.8972746331236897,
    "rigs.quadruped.sigma_coverage_gap": 0.05704192872117397,
    "rigs.quadruped.within_1_m": 0.954,
    "rigs.repeating.covariance_95_coverage": 0.8549222797927462,
    "rigs.repeating.ece": 0.4859864538822616,
    "rigs.repeating.right_but_refused": 0.095,
    "rigs.repeating.sigma_coverage_gap": 0.1356528497409326,
    "rigs.repeating.within_1_m": 0.4825,
    "rigs.repeating.wrong_of_localized": 0.11428571428571428,
    "rigs.rings.ece": 0.17314814814814813,
    "rigs.rings.right_but_refused": 0.374,
    "rigs.rings.within_1_m": 0.374,
    "rigs.robot.right_but_refused": 0.1326923076923077,
    "rigs.robot.sigma_coverage_gap": 0.05033333333333323,
    "rigs.robot.within_1_m": 0.8653846153846154,
    "rigs.stereo.covariance_95_coverage": 0.8771790808240888,
    "rigs.stereo.sigma_coverage_gap": 0.06739619651347062,
    "rigs.stereo.within_1_m": 0.9231894659839064,
    "rigs.vlp_16.covariance_95_coverage": 0.8888888888888888,
    "rigs.vlp_16.sigma_coverage_gap": 0.20386868686868687,
    "rigs.zed2.right_but_refused": 0.72,
    "rigs.zed2.sigma_coverage_gap": 0.056777777777777705,
    "rigs.zed2.within_1_m": 0.72,
}
WHY_MISSED |= {row: Reason(value, _RIGS[row.rsplit(".", maxsplit=1)[1]]) for row, value in _RIG_VALUES.items()}
#: Families of which no answer is LOCALIZED.
_NONE_LOCALIZED = (
    "No answer of this family is LOCALIZED, so there is no share of them, and nothing shows that the bar holds. See "
    "rigs.{family}.right_but_refused for what is refused"
)
WHY_MISSED |= {
    f"rigs.{family}.wrong_of_localized": Reason(None, _NONE_LOCALIZED.format(family=family))
    for family in ("iphone", "kinect", "rings", "zed2")
}
