"""The frame of the page, and the controls of its figures."""

from pancam_graph.report._packed import HEAD

__all__ = ["NO_VECTORS", "PAGE", "SCENE_CONTROLS", "VECTOR_CONTROLS"]

SCENE_CONTROLS = (
    '<div class="controls"><label>View <select id="scene-view"></select></label>'
    "<span>Drag to turn, wheel to zoom, right button to move.</span></div>\n"
)
VECTOR_CONTROLS = """<div class="controls">
<label>Image (largest residuals first) <select id="vectors-image"></select></label>
<label>Length of vectors <select id="vectors-scale"><option value="same">same scale before and after</option>
<option value="own">each enlarged to be seen</option></select></label>
<span id="vectors-note"></span></div>
"""
NO_VECTORS = (
    "<section>\n<h2>Residuals in single images</h2>\n"
    "<p>No image has observations, so there is nothing to draw.</p>\n</section>"
)
PAGE = (
    HEAD
    + """{verdict}{warnings}
<dl class="figures">
{headline}
</dl>
</header>
<main>
{mosaics}{terrain}<div class="pair">
{map}
{histogram}
</div>
{scene}
{vectors}
{corrections}
{rig}{cross_validation}
<section>
<h2>Observations</h2>
{observations}
<p class="caption">What was left out, and why; each observation's reason is in <code>residuals.npz</code>.
Those that came back were set aside while the geometry was still rough.</p>
</section>
{matching}
<section>
<h2>Images</h2>
{images}
<p class="caption">Press a head to sort.</p>
</section>
<section>
<h2>Stops</h2>
{stops}
<p class="caption">Shift and turn count from the pose that the input gave; roll, pitch and heading are turns
about the mast's x (forward), y (left) and z (up) axes.</p>
</section>
<section class="notes">
<h2>How to read this</h2>
<ul>
<li>Sigmas and ellipses are <em>formal</em>: they follow from the noise assumed for pixels, pointing and
positions, with the terrain points free. Where the rig was estimated they know how uncertain it is, as far as
the prior says. Of wrong matches, and of errors of lenses that no number of the rig describes, they know
nothing. A cross-validation checks them.</li>
<li>“Before” is the state from which the adjustment started, with points triangulated there;
“after” is its result, over the same observations.</li>
<li>A residual is projected minus measured, in pixels of the raw image; u runs right, v down, and (0, 0) is
the centre of the top-left pixel. RMS is the root mean square length of these vectors.</li>
<li>The world is right-handed and metric, z up. Pan is positive anticlockwise seen from above, tilt positive
upwards. All conventions: <code>docs/conventions.md</code> of pancam_graph.</li>
<li>All numbers in full: <code>solution.json</code> and <code>residuals.npz</code> beside this page.</li>
</ul>
</section>
</main>
<script type="text/plain" id="packed-plotly">{plotly}</script>
<script type="text/plain" id="packed-figures">{figures}</script>
<script>{script}</script>
</body>
</html>
"""
)
