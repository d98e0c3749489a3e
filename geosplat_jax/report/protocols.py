"""The evaluation protocols of the field, as data; `protocol_metrics` computes their metrics.

Numbers of papers with different protocols are not comparable. So every protocol has a name, and is
a row of the table `PROTOCOL`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Int


@dataclass(frozen=True)
class Rendition:
    """How linear colours become pictures, and how these are compared.

    Attributes
    ----------
    encoding : ``linear``, ``srgb`` or ``gamma22``, value^(1/2.2).
    background : grey behind the object, encoded.
    silhouette : how the prediction is composited over the background. ``alpha`` blends it by its
        own alpha; ``solid`` shows it unblended where its alpha exceeds one half; ``mask`` blends it
        by the true mask, so that predictions outside of the object do not count. The truth is
        always blended by its mask.
    is_by_channel : whether the PSNR of an image is the mean of the PSNR of its channels; otherwise
        it is that of the mean error of all channels, which is never higher.
    """

    encoding: Literal["linear", "srgb", "gamma22"]
    background: float
    silhouette: Literal["alpha", "solid", "mask"]
    is_by_channel: bool = False


@dataclass(frozen=True)
class ObjectFigure:
    """One figure of Stanford-ORB.

    Attributes
    ----------
    name : name of the figure.
    largest : linear values are clipped to [0, largest]; the peak of the PSNR is always one.
    is_brightened : whether both images are first multiplied by the factor by which the sRGB curve
        raises the sum of the truth.
    is_encoded : whether images are compared in sRGB, after clipping.
    """

    name: str
    largest: float
    is_brightened: bool
    is_encoded: bool


@dataclass(frozen=True)
class ObjectRendition:
    """How Stanford-ORB compares images: on the object alone, and most of them after a scale.

    The true mask is eroded by 5 x 5 pixels, and pixels outside are black in both images. Errors are
    means over *all* pixels, that is those over the object times its share of the image. The PSNR of
    an image is at least that of a uniform grey of 0.5 inside the mask. The benchmark's images have
    512 x 512 pixels.

    Attributes
    ----------
    figures : figures that are computed.
    is_scaled : whether each channel of each image is scaled by least squares over the pixels
        inside. The benchmark scales albedo and relit images, but no new views.
    """

    figures: tuple[ObjectFigure, ...]
    is_scaled: bool = True


@dataclass(frozen=True)
class Protocol:
    """The choices that make the metrics of different papers incomparable.

    Attributes
    ----------
    name : one of `PROTOCOLS`.
    albedo_scale : ``least_squares`` for each view, averaged over the views, or ``median`` of the
        ratios of all pixels; always per channel, in linear colour.
    scale_skips_black : whether ``median`` leaves out pixels whose true albedo is zero in a channel.
    scale_views : number of views, spread evenly, that the scale is fitted to; None for all.
    albedo, relight : renditions of albedo and of relit images.
    albedo_is_pooled : whether the PSNR of albedo is that of the error over all images; otherwise,
        and for relit images always, it is the mean of the PSNR of every image.
    lpips_nets : networks of the perceptual distance; see `lpips_note`.
    new_views : rendition of new views besides `NEW_VIEWS`, or None.
    """

    name: str
    albedo_scale: Literal["least_squares", "median"]
    scale_views: int | None
    albedo: Rendition | ObjectRendition
    albedo_is_pooled: bool
    relight: Rendition | ObjectRendition
    lpips_nets: tuple[str, ...]
    new_views: ObjectRendition | None = None
    scale_skips_black: bool = False


_ORB_FIGURES = (
    ObjectFigure("psnr_h", 4.0, is_brightened=True, is_encoded=False),
    ObjectFigure("psnr_l", 1.0, is_brightened=False, is_encoded=True),
)


PROTOCOL: Mapping[str, Protocol] = {
    row.name: row
    for row in (
        Protocol(
            name="geosplatting",
            albedo_scale="least_squares",
            scale_views=None,
            albedo=Rendition("srgb", 0.0, "alpha"),
            albedo_is_pooled=False,
            relight=Rendition("srgb", 1.0, "alpha"),
            lpips_nets=("alex",),
        ),
        Protocol(
            name="tensoir",
            albedo_scale="median",
            scale_views=20,
            albedo=Rendition("gamma22", 1.0, "mask"),
            albedo_is_pooled=True,
            relight=Rendition("srgb", 1.0, "solid"),
            lpips_nets=("alex", "vgg"),
        ),
        Protocol(
            name="irgs",
            albedo_scale="median",
            scale_views=None,
            albedo=Rendition("linear", 0.0, "mask", is_by_channel=True),
            albedo_is_pooled=False,
            relight=Rendition("srgb", 0.0, "mask", is_by_channel=True),
            lpips_nets=("vgg",),
            scale_skips_black=True,
        ),
        Protocol(
            name="orb",
            albedo_scale="least_squares",
            scale_views=None,
            albedo=ObjectRendition(
                (ObjectFigure("psnr", 1.0, is_brightened=False, is_encoded=False),)
            ),
            albedo_is_pooled=False,
            relight=ObjectRendition(_ORB_FIGURES),
            lpips_nets=("vgg",),
            new_views=ObjectRendition(_ORB_FIGURES, is_scaled=False),
        ),
    )
}
"""The protocols by name."""

NEW_VIEWS = Rendition("srgb", 1.0, "alpha")
"""How new views under the training light are compared in every protocol."""

PROTOCOLS = tuple(PROTOCOL)
"""Names of the protocols, the default first."""


def protocol(name: str) -> Protocol:
    """Return the protocol of a name.

    Raises
    ------
    ValueError : there is no protocol of that name.
    """
    if name not in PROTOCOL:
        raise ValueError(f"there is no protocol {name!r}; choose one of {', '.join(PROTOCOLS)}")
    return PROTOCOL[name]


def lpips_note(protocol: Protocol) -> str:
    """Say which networks the protocol's perceptual distance would use, and why it is missing."""
    networks = " and ".join(protocol.lpips_nets)
    return (
        f"LPIPS is left out: protocol {protocol.name!r} measures it with the trained weights of "
        f"{networks}, which are a download and no part of this package"
    )


def scale_views(protocol: Protocol, count: int) -> Int[np.ndarray, " K"]:
    """Choose the views, among ``count``, that the albedo scale is fitted to.

    These are every ``count // scale_views``-th view from the first on, at most ``scale_views``; all
    views if there are no more than that.
    """
    view_count = min(count, protocol.scale_views or count)
    return np.arange(view_count) * (count // max(view_count, 1))
