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
