"""The report's page: template, style and the few lines of script. Self-contained; opens without a network.

Kept as Python so that the code digest of the stage holds it. Surrounds are neutral grey, as a colour must be judged.
"""

from __future__ import annotations

import functools
from typing import Any

STYLE = """
:root { color-scheme: light dark; --bg: #ececeb; --card: #f8f8f7; --ink: #1c1d1f; --soft: #62656a; --rule: #d3d4d5;
  --accent: #b4541a; --good: #2c8a4b; --fair: #c58a10; --bad: #c23b32; --none: #9a9da1; --chip: #e3e3e2; }
@media (prefers-color-scheme: dark) { :root { --bg: #1b1c1e; --card: #242629; --ink: #e8e8e6; --soft: #9da1a6;
  --rule: #393c40; --accent: #f0965a; --good: #58c07c; --fair: #e2b04a; --bad: #ee7268; --none: #6d7176;
  --chip: #303338; } }
* { box-sizing: border-box; }
html { scroll-behavior: smooth; scroll-padding-top: 1rem; }
body { margin: 0; background: var(--bg); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", Helvetica, Arial,
  sans-serif; font-variant-numeric: tabular-nums; }
a { color: inherit; }
.shell { display: grid; grid-template-columns: 190px minmax(0, 1fr); gap: 2.2rem; max-width: 1360px; margin: 0 auto;
  padding: 0 1.6rem 5rem; }
nav { position: sticky; top: 0; align-self: start; padding: 1.7rem 0; max-height: 100vh; overflow: auto;
  font-size: 13.5px; }
nav a { display: flex; justify-content: space-between; gap: .5rem; padding: .22rem .55rem; border-radius: 5px;
  text-decoration: none; color: var(--soft); }
nav a:hover { background: var(--chip); color: var(--ink); }
nav .brand { font-weight: 700; color: var(--ink); font-size: 16px; letter-spacing: .01em; margin-bottom: .5rem; }
nav .s { opacity: .75; }
nav .w { color: var(--fair); font-weight: 700; }
header { padding: 1.5rem 0 .9rem; }
h1 { font-size: 30px; line-height: 1.15; margin: 0 0 .25rem; letter-spacing: -.015em; font-weight: 680; }
h2 { font-size: 20px; margin: 0; letter-spacing: -.005em; font-weight: 660; }
h3 { font-size: 13px; margin: 1.35rem 0 .45rem; color: var(--soft); font-weight: 600; text-transform: uppercase;
  letter-spacing: .05em; }
.lead { color: var(--soft); margin: 0; max-width: 74ch; }
section { border-top: 1px solid var(--rule); padding: 1.7rem 0 .6rem; margin-top: 1.5rem; }
.sechead { display: flex; align-items: baseline; gap: .8rem; flex-wrap: wrap; margin-bottom: .25rem; }
.sechead .t { color: var(--soft); font-size: 13.5px; }
.compare { position: relative; --x: 50%; border-radius: 7px; overflow: hidden; background: #777; line-height: 0;
  touch-action: pan-y; }
.compare img { width: 100%; height: auto; display: block; }
.compare .over { position: absolute; inset: 0; clip-path: inset(0 calc(100% - var(--x)) 0 0); }
.compare .bar { position: absolute; top: 0; bottom: 0; left: var(--x); width: 2px; margin-left: -1px; background: #fff;
  box-shadow: 0 0 5px #0009; pointer-events: none; }
.compare .bar::after { content: "\\2039\\00a0\\203a"; position: absolute; top: 50%; left: 50%; width: 34px;
  height: 34px; margin: -17px; border-radius: 50%; background: #fff; color: #222;
  font: 700 18px/31px system-ui, sans-serif; text-align: center; box-shadow: 0 1px 6px #0007; }
.compare input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize; }
.compare:focus-within { outline: 2px solid var(--accent); outline-offset: 2px; }
.tag { position: absolute; top: 11px; padding: 3px 10px; border-radius: 20px; background: #000a; color: #fff;
  font: 600 12px/18px system-ui, sans-serif; pointer-events: none; }
.tag.l { left: 11px; } .tag.r { right: 11px; }
.cards { display: grid; grid-template-columns: repeat(auto-fill, minmax(176px, 1fr)); gap: .75rem; margin: 1rem 0; }
.card { background: var(--card); border-radius: 7px; padding: .75rem .9rem .7rem; border-left: 4px solid var(--none); }
.card.good { border-left-color: var(--good); } .card.fair { border-left-color: var(--fair); }
.card.bad { border-left-color: var(--bad); }
.card .k { font-size: 13px; color: var(--soft); line-height: 1.3; }
.card .v { font-size: 25px; font-weight: 660; letter-spacing: -.01em; margin: .08rem 0; }
.card .m { font-size: 12.5px; color: var(--soft); line-height: 1.4; }
.card .verdict { font-weight: 650; } .good .verdict { color: var(--good); } .fair .verdict { color: var(--fair); }
.bad .verdict { color: var(--bad); }
.figs { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 1.1rem; margin: 1rem 0;
  align-items: start; }
.figs:has(> figure:only-child) { grid-template-columns: minmax(0, 640px); }
.figs:has(> figure:nth-child(4):last-child):not(:has(> .wide)) { grid-template-columns: 1fr 1fr; }
.tables { display: flex; flex-wrap: wrap; gap: 0 3rem; } .tables > div { min-width: 0; max-width: 100%; }
figure { margin: 0; } figure.wide { grid-column: 1 / -1; } .figs.three { grid-template-columns: repeat(3, 1fr); }
.frame { position: relative; border-radius: 5px; overflow: hidden; background: #777; line-height: 0; cursor: zoom-in; }
.frame img { width: 100%; height: auto; display: block; }
.frame svg { position: absolute; inset: 0; width: 100%; height: 100%; overflow: hidden; }
figcaption { font-size: 13px; color: var(--soft); margin-top: .42rem; line-height: 1.42; }
figcaption b { color: var(--ink); font-weight: 620; }
svg polyline { fill: none; vector-effect: non-scaling-stroke; stroke-width: 1.4; stroke-linejoin: round; }
polyline.grid { stroke: #ffffff9c; stroke-width: 1; } polyline.edge { stroke: #ffd23e; stroke-width: 1.8; }
polyline.board { stroke: #38e0ff; } polyline.x { stroke: #ff4b3e; stroke-width: 3.2; }
polyline.y { stroke: #47e05c; stroke-width: 3.2; } polyline.z { stroke: #4d8dff; stroke-width: 3.2; }
polyline.ball { stroke: #ff4fd8; stroke-width: 1.6; } polyline.horizon { stroke: #fffa; stroke-dasharray: 5 5; }
polyline.foot { stroke: #ff8b3d; stroke-width: 2.2; }
svg text { font-family: system-ui, sans-serif; font-weight: 650; fill: #fff; paint-order: stroke; stroke: #000c;
  stroke-width: 3px; stroke-linejoin: round; text-anchor: middle; }
.ramp { display: flex; align-items: center; gap: .5rem; margin-top: .4rem; font-size: 12px; color: var(--soft); }
.ramp i { flex: 1; height: 8px; border-radius: 4px; }
.ramp i.heat { background: linear-gradient(90deg, {{ heat }}); }
.ramp i.signed { background: linear-gradient(90deg, rgb(38 94 170), rgb(246 246 244), rgb(178 42 52)); }
.legend { display: flex; flex-wrap: wrap; gap: .15rem .9rem; margin-top: .4rem; font-size: 12.5px; color: var(--soft); }
.legend i { display: inline-block; width: 11px; height: 11px; border-radius: 2px; margin-right: .38rem;
  outline: 1px solid #8885; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13.5px; margin: .35rem 0 .7rem; min-width: 50%; }
th, td { padding: .3rem .95rem .3rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--rule); }
th { font-weight: 600; color: var(--soft); font-size: 12.5px; white-space: nowrap; }
td.n { text-align: right; white-space: nowrap; } th.n { text-align: right; }
td .dot, .dot { display: inline-block; width: 9px; height: 9px; border-radius: 50%; background: var(--none);
  margin-right: .45rem; }
.dot.good { background: var(--good); } .dot.fair { background: var(--fair); } .dot.bad { background: var(--bad); }
.two { columns: 2 330px; column-gap: 2.4rem; } .two table { min-width: 100%; }
.row { display: flex; justify-content: space-between; gap: 1rem; border-bottom: 1px solid var(--rule);
  padding: .22rem 0; font-size: 13.5px; break-inside: avoid; }
.row span:first-child { color: var(--soft); } .row span:last-child { text-align: right; overflow-wrap: anywhere; }
.warn { background: color-mix(in srgb, var(--fair) 15%, var(--card)); border-left: 4px solid var(--fair);
  border-radius: 5px; padding: .5rem .85rem; margin: .45rem 0; font-size: 13.5px; }
.yes { color: var(--good); font-weight: 650; } .no { color: var(--soft); font-weight: 650; }
details { margin: .5rem 0; font-size: 13.5px; } summary { cursor: pointer; color: var(--soft); }
.time { width: 100%; height: 30px; border-radius: 5px; overflow: hidden; display: flex; margin: .7rem 0 .35rem; }
.time i { min-width: 1px; } code { font: 12.5px ui-monospace, Menlo, Consolas, monospace; overflow-wrap: anywhere; }
dialog { border: 0; padding: 0; background: transparent; max-width: 96vw; max-height: 96vh; overflow: hidden; }
dialog::backdrop { background: #101010ee; } dialog .frame { cursor: zoom-out; }
dialog .frame img { max-width: 96vw; max-height: 96vh; width: auto; min-width: min(900px, 90vw); }
@media (max-width: 860px) { .shell { grid-template-columns: minmax(0, 1fr); padding: 0 .9rem 3rem; }
  nav { display: none; } .figs.three { grid-template-columns: 1fr; } }
@media print { nav, .compare input { display: none; } .shell { display: block; } section { break-inside: avoid; } }
"""

SCRIPT = """
const big = document.querySelector('dialog');
document.querySelectorAll('figure .frame').forEach(f => f.addEventListener('click', () => {
  big.replaceChildren(f.cloneNode(true)); big.showModal(); }));
big.addEventListener('click', () => big.close());
"""

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }} – insitu</title><style>{{ style | safe }}</style></head><body>
{%- macro figure(f) %}
<figure class="{{ f.width }}"><div class="frame"><img src="{{ f.uri }}" alt="{{ f.title }}" loading="lazy">
{%- if f.lines or f.labels %}<svg viewBox="0 0 {{ f.size[0] }} {{ f.size[1] }}" preserveAspectRatio="none"
 aria-hidden="true">
{%- for l in f.lines %}<polyline class="{{ l.style }}" points="{{ l.points }}"/>{% endfor %}
{%- for t in f.labels %}<text x="{{ '%.1f' | format(t.x) }}" y="{{ '%.1f' | format(t.y) }}"
 font-size="{{ (f.size[0] / {'wide': 52, 'half': 44}.get(f.width, 25)) | round(1) }}">
{{- t.text }}</text>{% endfor %}</svg>{% endif %}</div>
{%- if f.bar %}<div class="ramp"><span>{{ f.bar.low }}</span><i class="{{ f.bar.kind }}"></i>
<span>{{ f.bar.high }}</span></div>{% endif %}
{%- if f.legend %}<div class="legend">{% for c, t in f.legend %}<span><i style="background:{{ c }}"></i>{{ t }}</span>
{%- endfor %}</div>{% endif %}
<figcaption><b>{{ f.title }}</b>{% if f.caption %} {{ f.caption }}{% endif %}</figcaption></figure>
{%- endmacro %}
{%- macro cards(list) %}<div class="cards">{% for c in list %}
<div class="card {{ c.light }}"><div class="k">{{ c.name }}</div><div class="v">{{ c.value }}</div>
<div class="m">{% if c.verdict %}<span class="verdict">{{ c.verdict }}</span>{% endif %}
{%- if c.verdict and c.note %} · {% endif %}{{ c.note }}</div></div>{% endfor %}</div>{% endmacro %}
{%- macro table(t) %}{% if t.title %}<h3>{{ t.title }}</h3>{% endif %}<div class="scroll"><table><thead><tr>
{%- for h in t.head %}<th{% if not loop.first and t.numeric %} class="n"{% endif %}>{{ h }}</th>{% endfor %}
</tr></thead><tbody>{% for r in t.rows %}<tr>{% for c in r %}<td
{%- if not loop.first and t.numeric %} class="n"{% endif %}>
{%- if c is mapping %}<span class="dot {{ c.light }}"></span>{{ c.text }}{% else %}{{ c }}{% endif %}</td>
{%- endfor %}</tr>{% endfor %}</tbody></table></div>{% endmacro %}
<div class="shell"><nav><a class="brand" href="#top">insitu</a>
{%- if ball %}<a href="#ball">the ball</a>{% endif %}
{%- for s in sections %}<a href="#{{ s.name }}"><span>{{ s.name }}{% if s.warnings %} <span class="w"
 title="warnings">!</span>{% endif %}</span><span class="s">{{ s.seconds }}</span></a>{% endfor %}
<a href="#provenance">provenance</a></nav>
<main id="top"><header><h1>{{ title }}</h1><p class="lead">{{ lead }}</p></header>
<div class="compare" id="compare"><img src="{{ after }}" alt="The composite">
<img class="over" src="{{ before }}" alt="The plate">
<span class="tag l">plate</span><span class="tag r">with objects</span><div class="bar"></div>
<input type="range" min="0" max="100" value="50" step="0.1" aria-label="Plate against composite"
 oninput="this.parentNode.style.setProperty('--x', this.value + '%')"></div>
{{ cards(headline) }}
{%- if headline_note %}<p class="lead">{{ headline_note }}</p>{% endif %}
{%- if warning_count %}<div class="warn">{{ warning_count }}
 warning{{ 's' if warning_count > 1 }} below: {% for s in sections if s.warnings %}<a href="#{{ s.name }}">
{{- s.name }}</a>{{ ', ' if not loop.last }}{% endfor %}.</div>{% endif %}
{%- if ball %}<section id="ball"><div class="sechead"><h2>The ball, photographed and rendered</h2></div>
<p class="lead">{{ ball.text }}</p>{% for row in ball.rows %}<div class="figs three">
{%- for f in row %}{{ figure(f) }}{% endfor %}</div>{% endfor %}</section>{% endif %}
{%- for s in sections %}
<section id="{{ s.name }}"><div class="sechead"><h2>{{ s.title }}</h2><span class="t">{{ s.name }}
{%- if s.seconds %} · {{ s.seconds }}{% endif %}</span></div><p class="lead">{{ s.text }}</p>
{%- for w in s.warnings %}<div class="warn">{{ w }}</div>{% endfor %}
{%- if s.cards %}{{ cards(s.cards) }}{% endif %}
{%- if s.figures %}<div class="figs">{% for f in s.figures %}{{ figure(f) }}{% endfor %}</div>{% endif %}
{%- if s.tables %}<div class="tables">{% for t in s.tables %}<div>{{ table(t) }}</div>{% endfor %}</div>{% endif %}
{%- if s.numbers %}{% if s.numbers | length > 16 %}<details><summary>All {{ s.numbers | length }} measured
 numbers</summary>{% else %}<h3>Measured</h3>{% endif %}<div class="two">{% for k, v in s.numbers %}
<div class="row"><span>{{ k }}</span><span>{{ v }}</span></div>{% endfor %}</div>
{%- if s.numbers | length > 16 %}</details>{% endif %}{% endif %}
{%- if s.evidence %}<h3>What was modelled, and why</h3><div class="scroll"><table><thead><tr><th>term</th>
<th>modelled</th><th>because</th><th>could cost</th><th>bound</th></tr></thead><tbody>{% for e in s.evidence %}
<tr><td>{{ e.term }}</td>
<td>{% if e.modelled is sameas true %}<span class="yes">yes</span>{% elif e.modelled is sameas false %}
<span class="no">no</span>{% else %}{{ e.modelled }}{% endif %}</td><td>{{ e.because }}</td><td>{{ e.could_cost }}</td>
<td>{{ e.bound }}</td></tr>{% endfor %}</tbody></table></div>{% endif %}
{%- if s.params %}<details><summary>Settings</summary><div class="two">{% for k, v in s.params %}
<div class="row"><span>{{ k }}</span><span>{{ v }}</span></div>{% endfor %}</div></details>{% endif %}</section>
{%- endfor %}
<section id="provenance"><div class="sechead"><h2>Provenance</h2></div><p class="lead">What this result was made from
 and with.</p>{% if times %}<h3>Seconds per stage</h3><div class="time">{% for t in times %}<i
 style="flex:{{ t.share }};background:{{ t.colour }}" title="{{ t.name }} {{ t.text }}"></i>{% endfor %}</div>
<div class="legend">{% for t in times %}<span><i style="background:{{ t.colour }}"></i>{{ t.name }} {{ t.text }}</span>
{%- endfor %}</div>{% endif %}
{%- for t in provenance %}{% if t.folded %}<details><summary>{{ t.title }}</summary>{{ table(t.inner) }}</details>
{%- else %}{{ table(t) }}{% endif %}{% endfor %}</section>
</main></div><dialog></dialog><script>{{ script | safe }}</script></body></html>
"""


@functools.cache
def _template() -> Any:
    from jinja2 import Environment, StrictUndefined

    return Environment(autoescape=True, undefined=StrictUndefined).from_string(TEMPLATE)


def render(heat: str, **context: Any) -> str:
    """The page. ``heat``: CSS colour stops of the heat bar; the rest is what the template names, all of it."""
    return _template().render(style=STYLE.replace("{{ heat }}", heat), script=SCRIPT, **context) + "\n"
