"""Recordings of the bundled twins: `nisus data` lists, downloads and converts them, as do the cards of the gallery."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    commands={"data": Part(f"{__name__}.arguments:DataCommand", f"{__name__}.command:data")},
    gallery={
        "/api/gallery/data": Part("", f"{__name__}.gallery:state_route"),
        "/api/gallery/data/get": Part("", f"{__name__}.gallery:begin_route"),
    },
)
