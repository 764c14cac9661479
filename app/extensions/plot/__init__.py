"""Pictures drawn by Matplotlib, without a browser: a track (`nisus fold --plot`, `track.plot()`), and gallery cards."""

from config.extensions import Extension, Part

EXTENSION = Extension(
    pictures={
        "track": Part("", f"{__name__}.track:plotter"),
        "twin": Part("", f"{__name__}.card:draw_card"),
    }
)
