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
  const drawing = WebGL2RenderingContext.prototype;
  const given = Object.fromEntries(["drawElements", "drawArrays", "drawElementsInstanced", "drawArraysInstanced"].map((name) => [name, drawing[name]]));
  const shown = () => {
    hidden.remove();
    Object.assign(drawing, given);
  };
  setTimeout(shown, LONGEST);
  let drawn = 0;
  for (const [name, draw] of Object.entries(given))
    drawing[name] = function (...place) {
      if (drawn === 0) requestAnimationFrame(() => (drawn = 0));
      drawn += 1;
      if (drawn === SCENE) setTimeout(shown, AFTER);
      return draw.apply(this, place);
    };
}
