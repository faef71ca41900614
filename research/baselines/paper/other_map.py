"""The paper's network on a map that it was not trained on, for example of a real street.

The classes of the network are streets of the city in which it learned, so its softmax says nothing here. Its features for K-NN do. The
known samples are the scans of the survey, seen along the street and against it. Scans and image pairs are both drawn on the view grid,
because in the image spaces of the paper the two do not match (``one_space`` in ``variants.PLANS``).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from research.baselines.paper.cnn import PaperCnn
from research.baselines.paper.knn import Gallery
from research.baselines.paper.pictures import Pictures, drawn_views, turned_views
from research.baselines.paper.train import outputs
from research.baselines.paper_data.frames import levelled_panorama
from research.baselines.paper_data.pairs import levelled_view
from service.imaging.view_grid import ViewGrid


def nearest_scans(net: PaperCnn, dataset: Dataset, frames: Sequence[QueryFrame]) -> NDArray[np.float64]:
    """Return the positions (n, 2) of the scans whose features are nearest to those of each image pair, map frame, metres.

    The vote of the paper's K-NN over streets cannot decide on a map of one street, so the nearest sample answers.

    Args:
        net: the trained network.
        dataset: dataset with the survey.
        frames: image pairs.
    """
    grid, xy = ViewGrid(), dataset.survey_poses()[:, :2, 3]
    panoramas = [levelled_panorama(dataset.scan(number), grid)[0] for number in range(len(xy))]
    along, against = (turned_views(panoramas, np.full(len(xy), heading)) for heading in (0.0, np.pi))
    known = _features(net, drawn_views(np.concatenate([along, against]), None))
    gallery = Gallery(known, np.concatenate([xy, xy]), np.zeros(len(known), np.int64))
    views = [levelled_view(frame.rgb(), frame.depth_m(), frame.camera.pinhole(), grid) for frame in frames]
    asked = drawn_views(np.stack([view[0] for view in views]), np.stack([view[1] for view in views]))
    found: NDArray[np.float64] = gallery.xy[gallery.neighbours(_features(net, asked), 1)[:, 0]]
    return found


def _features(net: PaperCnn, pictures: Pictures) -> NDArray[np.float32]:
    return outputs(net, lambda rows: pictures[rows], len(pictures))[0]
