// Goes ahead of Viser's own script, in its page: in the dark its labels are light on dark. Viser draws them black on
// white boxes, and has no choice in it; where its shaders should read otherwise one day, they stay so.

if (new URLSearchParams(location.search).has("darkMode")) {
  const given = WebGL2RenderingContext.prototype.shaderSource;
  const GLYPH = /gl_FragColor\s*=\s*vec4\(0\.0,\s*0\.0,\s*0\.0,\s*a\)/;
  const BOX = /gl_FragColor\s*=\s*vec4\(1\.0,\s*1\.0,\s*1\.0,\s*0\.85\s*\*\s*vAlpha\)/;
  WebGL2RenderingContext.prototype.shaderSource = function (shader, source) {
    // The colours are ink and panel of style.css.
    const text = source.replace(GLYPH, "gl_FragColor = vec4(0.894, 0.918, 0.949, a)");
    given.call(this, shader, text.replace(BOX, "gl_FragColor = vec4(0.075, 0.102, 0.137, 0.7 * vAlpha)"));
  };
}
// Goes ahead of Viser's own script, in its page: nothing is seen of it until the scene is drawn. Before, its canvas is
// empty, then black, and its axes stand alone.

{
  const SCENE = 5; // drawings in one picture, at least: an empty scene has up to four
  const AFTER = 500; // ms without one more drawing in a picture: labels and the ground come one by one
  const LONGEST = 4000; // ms, after which an empty scene is shown; a canvas without any drawing is black
  const UNDRAWN = 20000; // ms, after which it is shown whatever there is
  const hidden = document.createElement("style");
  const dark = new URLSearchParams(location.search).has("darkMode");
  const [panel, faint] = dark ? ["#131a23", "#94a3b5"] : ["#ffffff", "#5b6a7d"]; // of chart.css
  hidden.textContent = `:root, body { background: ${panel} !important; } body { opacity: 0; } :root::after { content: "Loading the scene …"; position: fixed; inset: 46% 0 auto; text-align: center; font: 13px system-ui, sans-serif; color: ${faint}; }`;
  document.head.append(hidden);
  const drawing = WebGL2RenderingContext.prototype;
  const given = Object.fromEntries(["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"].map((name) => [name, drawing[name]]));
  const shown = () => {
    hidden.remove();
    Object.assign(drawing, given);
  };
  let [drawn, most, late, settled] = [0, 0, false, null];
  setTimeout(() => {
    late = true;
    if (most > 0 && most < SCENE) shown();
  }, LONGEST);
  setTimeout(shown, UNDRAWN);
  for (const [name, draw] of Object.entries(given))
    drawing[name] = function (...place) {
      if (drawn === 0) requestAnimationFrame(() => (drawn = 0));
      drawn += 1;
      if (drawn > most) {
        most = drawn;
        clearTimeout(settled);
        if (late || most >= SCENE) settled = setTimeout(shown, AFTER);
      }
      return draw.apply(this, place);
    };
}

// In a window of its own: the way back to charts and controls. The frame's address has `scene`.
if (!new URLSearchParams(location.search).has("scene"))
  addEventListener("DOMContentLoaded", () => {
    const link = Object.assign(document.createElement("a"), { href: "../", textContent: "Charts and controls" });
    link.style.cssText = "position: fixed; z-index: 1; top: 12px; right: 14px; font: 13px system-ui, sans-serif; color: #3d8fe0;";
    document.body.append(link);
  });
