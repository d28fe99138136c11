"""The style sheet of the report: light in every mode, because the figures are drawn for paper."""

CSS = """
:root { color-scheme: light; --ink: #1c2430; --muted: #6a7383; --line: #e2e6ec; --soft: #f7f8fa; --accent: #1f5fa8; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 44px 28px 72px; }
h1 { font-size: 30px; line-height: 1.2; letter-spacing: -0.015em; margin: 2px 0 10px; overflow-wrap: anywhere; }
h2 { font-size: 20px; letter-spacing: -0.01em; margin: 60px 0 4px; padding-top: 18px;
  border-top: 1px solid var(--line); }
h3 { font-size: 14px; margin: 30px 0 8px; }
p { margin: 0 0 12px; max-width: 80ch; }
.kicker { color: var(--muted); font-size: 13px; margin: 0; }
.lead { font-size: 17px; max-width: 75ch; }
.finding { font-size: 17px; max-width: 75ch; border-left: 3px solid var(--accent); padding-left: 14px;
  margin: 18px 0 24px; }
.cards { display: grid; grid-template-columns: repeat(4, 1fr); gap: 1px; background: var(--line);
  border: 1px solid var(--line); border-radius: 10px; overflow: hidden; margin: 24px 0; }
@media (max-width: 760px) { .cards { grid-template-columns: repeat(2, 1fr); } }
.card { background: #fff; padding: 14px 18px 13px; }
.card dt { color: var(--muted); font-size: 13px; }
.card dd { margin: 0; }
.card .figure { font-size: clamp(19px, 2.6vw, 27px); line-height: 1.25; font-weight: 640; letter-spacing: -0.02em;
  font-variant-numeric: tabular-nums; white-space: nowrap; }
.card .unknown { color: #a7aeb9; font-weight: 400; }
.card .arrow { color: #a7aeb9; font-weight: 400; padding: 0 0.22em; }
.card .note { color: var(--muted); font-size: 12.5px; line-height: 1.4; }
.notes { background: #fdf8ec; border: 1px solid #efe0b9; border-radius: 10px; padding: 12px 18px; margin: 24px 0; }
.notes h3 { margin: 0 0 4px; }
.notes ul { margin: 0; padding-left: 20px; }
.caption { color: var(--muted); font-size: 13.5px; max-width: 95ch; }
figure { margin: 14px 0 6px; overflow-x: auto; }
figure svg { display: block; width: 100%; min-width: 680px; height: auto; }
figure svg text {
  font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif !important; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 20px; margin: 14px 0 0; padding: 0; list-style: none;
  font-size: 13.5px; }
.swatch { display: inline-block; width: 1.25em; }
.scroll { overflow-x: auto; }
table { margin: 16px 0; border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }
th { font-weight: 600; text-align: left; color: var(--muted); font-size: 13px; vertical-align: bottom; }
th, td { padding: 6px 18px 6px 0; border-bottom: 1px solid var(--line); }
tbody th { color: var(--ink); font-size: 14px; font-weight: 400; overflow-wrap: anywhere; min-width: 9em;
  max-width: 24em; }
.number { text-align: right; }
.heat td { min-width: 58px; padding: 6px 12px; text-align: center; border: 2px solid #fff; }
.heat thead th:first-child { text-align: right; font-weight: 400; padding-right: 18px; }
.heat thead th { text-align: center; padding: 4px 12px; border: 0; }
.heat tbody th { border: 0; padding-right: 18px; }
.heat tr.mean td, .heat tr.mean th { color: var(--muted); font-size: 13px; }
.mass { display: grid; grid-template-columns: max-content 1fr; gap: 6px 14px; align-items: center;
  font-size: 13.5px; }
.bar { display: flex; height: 30px; border-radius: 5px; overflow: hidden; gap: 1.5px; background: #fff; }
.bar span { display: flex; align-items: center; justify-content: center; min-width: 0; overflow: hidden; color: #fff;
  font-size: 12.5px; font-weight: 600; white-space: nowrap; }
.missing { color: var(--muted); background: var(--soft); border-radius: 8px; padding: 14px 18px; }
details { margin: 14px 0; }
summary { cursor: pointer; font-weight: 600; font-size: 14px; }
pre { background: var(--soft); border-radius: 8px; padding: 14px 18px; overflow-x: auto; font-size: 12.5px;
  line-height: 1.5; }
code { font-size: 12.5px; overflow-wrap: anywhere; }
@media print { main { padding: 0; } h2 { break-after: avoid; } figure, .cards, table { break-inside: avoid; } }
"""
