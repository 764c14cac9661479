// Goes ahead of Viser's own script, in its page: nothing is seen of it until the scene is drawn. Before, its canvas is
// empty, then black, and its axes stand alone.

{
  const SCENE = 5; // drawings in one picture, at least: an empty scene has up to four
  const AFTER = 500; // ms, in which pictures, labels and the ground come
  const LONGEST = 4000; // ms, after which it is shown whatever there is
  const hidden = document.createElement("style");
  const panel = new URLSearchParams(location.search).has("darkMode") ? "#131a23" : "#ffffff"; // of style.css
  hidden.textContent = `:root, body { background: ${panel} !important; } body { opacity: 0; }`;
  document.head.append(hidden);
  const shown = () => hidden.remove();
  setTimeout(shown, LONGEST);
  const drawing = WebGL2RenderingContext.prototype;
  let drawn = 0;
  for (const name of ["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"]) {
    const given = drawing[name];
    drawing[name] = function (...place) {
      if (drawn === 0) requestAnimationFrame(() => (drawn = 0));
      drawn += 1;
      if (drawn === SCENE) setTimeout(shown, AFTER);
      return given.apply(this, place);
    };
  }
}
