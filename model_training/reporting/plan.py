"""The map from above in metres with the answers; SVG's y axis points down, so it is minus the map's y."""

from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from model_training.evaluation.failures import position_errors
from model_training.evaluation.predict import Predictions
from model_training.reporting.pictures import grey_webp_uri
from service.maps.map import Map
from service.registration.surfel_tiles import DRAWN_TILES

#: Classes of error: upper limit in metres, style class, and text of the legend.
ERRORS = ((0.5, "e0", "up to 0.5 m"), (1.0, "e1", "up to 1 m"), (5.0, "e2", "up to 5 m"), (np.inf, "e3", "over 5 m"))
_LONGEST_PX = 1400
_MARGIN_M = 8.0
#: Surfels are walls if the vertical part of their normal is smaller.
_UPRIGHT = 0.5
_GROUND_ID = "ground"


@dataclass(frozen=True, slots=True)
class Plan:
    """The map as an image, with its position.

    Attributes:
        picture: data URI of the image.
        view: x, -y of the upper left corner, width and height, metres.
    """

    picture: str
    view: tuple[float, float, float, float]

    @staticmethod
    def of(bundle: Map) -> "Plan":
        """Render the walls of the cloud; without a cloud, the plan only covers the places.

        Args:
            bundle: the map.
        """
        places = bundle.T_map_place[:, :2, 3]
        xy, upright = places, np.zeros(0, bool)
        drawn = () if bundle.cloud is None else bundle.cloud.parts(DRAWN_TILES)
        if any(len(part.surfels) for part in drawn):
            surfels = [part.unpacked(np.s_[:]) for part in drawn]
            xy = np.concatenate(
                [own["xyz"][:, :2] + part.origin_m[:2] for own, part in zip(surfels, drawn, strict=True)]
            )
            upright = np.abs(np.concatenate(surfels)["normal"][:, 2]) < _UPRIGHT
        low = np.minimum(xy.min(axis=0), places.min(axis=0)) - _MARGIN_M
        high = np.maximum(xy.max(axis=0), places.max(axis=0)) + _MARGIN_M
        size = high - low
        metre = _LONGEST_PX / float(size.max())
        width, height = (int(np.ceil(side * metre)) for side in size)
        alpha = np.zeros((height, width), np.float64)
        if upright.any():
            column, row = ((xy[upright] - [low[0], high[1]]) * [metre, -metre]).astype(int).T
            np.add.at(alpha, (np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)), 1.0)
            alpha = 255 * np.clip(np.log1p(alpha) / np.log(8.0), 0, 1)
        return Plan(
            grey_webp_uri(alpha.astype(np.uint8)), (float(low[0]), float(-high[1]), width / metre, height / metre)
        )

    def whole(self, predictions: Predictions) -> str:
        """Draw every query coloured by its error, with a line to an answer more than 5 m off; return SVG.

        Args:
            predictions: answers with ground truth.
        """
        errors, true_xy, answer_xy = (
            position_errors(predictions),
            predictions.T_true[:, :2, 3],
            predictions.T_answer[:, :2, 3],
        )
        unit = max(self.view[2:]) / 250
        lines, dots = [], []
        for k in np.argsort(-np.nan_to_num(errors, posinf=1e9))[
            ::-1
        ]:  # the worst are drawn last, so that nothing hides them
            kind = class_of(errors[k])
            x, y = true_xy[k]
            tooltip = f"query {k}: {'no answer' if not np.isfinite(errors[k]) else f'{errors[k]:.2f} m'}"
            if ERRORS[2][0] < errors[k] < np.inf:
                lines.append(_line(true_xy[k], answer_xy[k], "off"))
            mark = (
                _cross(x, -y, unit * 1.3, kind)
                if errors[k] > ERRORS[2][0]
                else f'<circle class="{kind}" cx="{x:.1f}" cy="{-y:.1f}" r="{unit:.2f}"/>'
            )
            dots.append(f"<g>{mark}<title>{tooltip}</title></g>")
        content = self._image() + "".join(lines) + "".join(dots)
        alt_text = "; ".join(f"{number} {name}" for name, number in counted(errors).items())
        return _drawing("The map from above with all queries", alt_text, content, view=self.view, kind="plan")

    def around(
        self,
        true_xy: NDArray[np.float64],
        answers_xy: NDArray[np.float64],
        others: NDArray[np.float64],
        *,
        with_picture: bool = False,
    ) -> str:
        """Draw a query's ground truth (circle), one or two answers (crosses) and other candidate poses (dots); return SVG.

        Args:
            true_xy: ground truth (2,), metres, map frame.
            answers_xy: answers (m, 2), metres, map frame; NaN for no answer.
            others: other candidates (n, 2), metres, map frame; NaN for none.
            with_picture: whether to include the map's image; other drawings of the page, also ``whole``, refer to it.
        """
        answered = np.isfinite(answers_xy).all(axis=1)
        seen = np.concatenate([true_xy[None], answers_xy[answered]])
        middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
        side = max(30.0, 1.4 * float(np.ptp(seen, axis=0).max()))
        view = (middle[0] - side * 2 / 3, -middle[1] - side / 2, side * 4 / 3, side)
        inside = others[np.isfinite(others).all(axis=1)]
        inside = inside[(np.abs(inside - middle) <= [side * 2 / 3, side / 2]).all(axis=1)]
        parts = [self._image() if with_picture else f'<use href="#{_GROUND_ID}"/>']
        parts += [f'<circle class="other" cx="{x:.1f}" cy="{-y:.1f}" r="{side / 70:.2f}"/>' for x, y in inside]
        for k in np.flatnonzero(answered):
            parts.append(_line(true_xy, answers_xy[k], "off"))
            parts.append(_cross(answers_xy[k, 0], -answers_xy[k, 1], side / 28, f"answer{k}"))
        parts.append(f'<circle class="truth" cx="{true_xy[0]:.2f}" cy="{-true_xy[1]:.2f}" r="{side / 28:.2f}"/>')
        alt_text = f"{side * 4 / 3:.0f} m across"
        return _drawing(
            "True and estimated position of the query", alt_text, "".join(parts), view=view, kind="small-plan"
        )

    def _image(self) -> str:
        return f'<image id="{_GROUND_ID}" href="{self.picture}" {_box(self.view)}/>'


def class_of(error_m: float) -> str:
    """Return the style class of an error; no answer is in the last class.

    Args:
        error_m: error, metres; infinite for no answer.
    """
    return next(name for reach, name, _ in ERRORS if error_m <= reach)


def counted(errors: NDArray[np.float64]) -> dict[str, int]:
    """Count the queries in each class of error; those without an answer are in the last.

    Args:
        errors: errors (n,), metres.
    """
    classes = [class_of(error) for error in errors]
    return {label: classes.count(name) for _, name, label in ERRORS}


def _drawing(title: str, alt_text: str, content: str, *, view: tuple[float, float, float, float], kind: str) -> str:
    """Return an SVG element with a description for screen readers.

    The drawings of a page share the map's image and the page's colours. So the page holds them as elements, not as images.
    """
    box = " ".join(f"{v:.2f}".rstrip("0").rstrip(".") for v in view)
    return (
        f'<svg class="{kind}" viewBox="{box}" role="img" aria-label="{escape(f"{title}: {alt_text}")}">{content}</svg>'
    )


def _box(view: tuple[float, float, float, float]) -> str:
    return 'x="{:.2f}" y="{:.2f}" width="{:.2f}" height="{:.2f}"'.format(*view)


def _line(start: NDArray[np.float64], end: NDArray[np.float64], kind: str) -> str:
    return f'<line class="{kind}" x1="{start[0]:.1f}" y1="{-start[1]:.1f}" x2="{end[0]:.1f}" y2="{-end[1]:.1f}"/>'


def _cross(x: float, y: float, r: float, kind: str) -> str:
    return f'<path class="{kind} cross" d="M{x - r:.2f} {y - r:.2f}l{2 * r:.2f} {2 * r:.2f}m0 {-2 * r:.2f}l{-2 * r:.2f} {2 * r:.2f}"/>'
