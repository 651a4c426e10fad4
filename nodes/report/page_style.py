"""Style sheet of the report, for screen and paper."""

CSS = """
:root { --ink: #1d2330; --soft: #5b6475; --line: #d9dde5; --tint: #f4f6f9; --good: #1b8a4b; --bad: #c0392b; }
* { box-sizing: border-box; }
body { margin: 0; background: #fff; color: var(--ink); font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto,
  "Helvetica Neue", "DejaVu Sans", Arial, sans-serif; }
main { max-width: 1020px; margin: 0 auto; padding: 28px 24px 60px; }
h1 { font-size: 26px; margin: 0; }
h2 { font-size: 18px; margin: 38px 0 8px; padding-top: 10px; border-top: 2px solid var(--ink); }
h3 { font-size: 15px; margin: 20px 0 4px; }
p { margin: 6px 0; } .soft, figcaption, .note { color: var(--soft); } .note, figcaption { font-size: 13px; }
.summary { font-size: 17px; margin: 12px 0 18px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(200px, 1fr)); gap: 10px; margin: 14px 0; }
.tile { background: var(--tint); border-left: 4px solid var(--line); padding: 9px 12px; }
.tile.good { border-color: var(--good); } .tile.bad { border-color: var(--bad); }
.tile.careful { border-color: #d08a1d; }
.tile b { display: block; font-size: 20px; line-height: 1.25; } .tile span { font-size: 12.5px; color: var(--soft); }
figure { margin: 12px 0 4px; } figure svg { width: 100%; height: auto; display: block; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 13px; margin: 6px 0 4px;
  font-variant-numeric: tabular-nums; }
th, td { padding: 4px 5px; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { font-weight: 600; background: var(--tint); }
tr:first-child > th:first-child, td:first-child, .left { text-align: left; }
tr.main td { font-weight: 600; background: #edf7f1; } td.wrap { white-space: normal; overflow-wrap: break-word; }
th.group { text-align: center; border-left: 1px solid var(--line); } .edge { border-left: 1px solid var(--line); }
.missing { background: #fff6e5; border-left: 4px solid #e0a100; padding: 8px 14px; font-size: 13.5px; }
.missing.bad { background: #fdecea; border-color: var(--bad); font-weight: 600; margin: 8px 0; }
.missing ul { margin: 2px 0; padding-left: 18px; }
footer { margin-top: 40px; color: var(--soft); font-size: 12.5px; }
@media print { @page { size: A4; margin: 14mm; } body { font-size: 11.5px; } main { max-width: none; padding: 0; }
  h2 { margin-top: 18px; padding-top: 6px; font-size: 15px; } h2, h3 { break-after: avoid; }
  figure, table, .tiles { break-inside: avoid; } .scroll { overflow: visible; }
  table { font-size: 8.6px; } th, td { padding: 2px 2.5px; }
  .tile b { font-size: 16px; } .tile span { font-size: 10.5px; }
  .note, figcaption, .missing { font-size: 10px; } .summary { font-size: 13.5px; }
  .tile, th, tr.main td, .missing { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""
