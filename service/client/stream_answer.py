"""The answer to one frame of a stream."""

from pydantic import Field

from service.contract.schema import LocalizeAnswer


class StreamAnswer(LocalizeAnswer):
    """Answer to one frame of a moving robot. Its ``belief`` has no token, because the stream keeps the track.

    Attributes:
        frames: number of frames that are registered together in the answer. 1: the newest frame decides, with the belief.
    """

    frames: int = Field(ge=0)
