//! The frame of every report page: one self-contained file, readable in light and dark, on paper
//! and by a screen reader.

use maud::{DOCTYPE, Markup, PreEscaped, Render, html};

/// A whole page around `body`.
pub fn page(title: &str, body: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width,initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                main {
                    h1 { (title) }
                    (body)
                }
            }
        }
    };
    page.into_string()
}

/// A table whose first column names the row.
pub fn table(caption: &str, headers: &[&str], rows: &[Vec<impl Render>]) -> Markup {
    html! {
        div.scroll {
            table {
                caption { (caption) }
                thead {
                    tr {
                        @for header in headers {
                            th scope="col" { (header) }
                        }
                    }
                }
                tbody {
                    @for cells in rows {
                        tr {
                            @for (column, cell) in cells.iter().enumerate() {
                                @if column == 0 {
                                    th scope="row" { (cell) }
                                } @else {
                                    td { (cell) }
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

const STYLE: &str = "
:root{--bg:#fff;--fg:#1c2024;--soft:#5b6570;--rule:#d9dee3;--panel:#f5f7f9;--a:#0b62c4;--b:#c2410c;--c:#15803d}
@media (prefers-color-scheme:dark){:root{--bg:#14171a;--fg:#e8ebee;--soft:#9aa5b1;--rule:#333a41;--panel:#1d2125;
--a:#6cb0ff;--b:#ff9a62;--c:#5fd08a}}
*{box-sizing:border-box}body{margin:0;background:var(--bg);color:var(--fg);font:16px/1.5 system-ui,sans-serif}
main{max-width:1120px;margin:0 auto;padding:24px 20px 64px}h1{font-size:1.6rem;margin:0 0 4px}
h2{font-size:1.2rem;margin:40px 0 8px}h3{font-size:1rem;margin:20px 0 6px}p{max-width:72ch}
.lead,.soft,caption,figcaption{color:var(--soft)}.scroll{overflow-x:auto}
table{border-collapse:collapse;margin:12px 0;font-variant-numeric:tabular-nums}
caption{text-align:left;padding:4px 0;font-size:.9rem}th,td{padding:5px 14px 5px 0;text-align:right;
border-bottom:1px solid var(--rule);white-space:nowrap}th[scope=row],thead th:first-child{text-align:left}
thead th{font-weight:600}tbody th{font-weight:400}
.plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(330px,1fr));gap:16px}
figure{margin:0;background:var(--panel);border-radius:8px;padding:12px}figcaption{font-size:.9rem}
svg.plot{width:100%;height:auto;display:block}svg text{font:12px system-ui,sans-serif;fill:var(--soft)}
svg .label,svg .legend{fill:var(--fg)}svg .grid{stroke:var(--rule)}svg .axis{stroke:var(--soft)}
svg .line{fill:none;stroke-width:2.2}svg .line.a{stroke:var(--a)}svg .line.b{stroke:var(--b)}svg .line.c{stroke:var(--c)}
svg .line.muted{stroke:var(--soft);stroke-dasharray:4 4;stroke-width:1.2}
svg .dot.a,svg .key.a,svg .bar.a{fill:var(--a)}svg .dot.b,svg .key.b,svg .bar.b{fill:var(--b)}
svg .dot.c,svg .key.c,svg .bar.c{fill:var(--c)}svg .key.muted{fill:var(--soft)}svg .bar{fill-opacity:.62}
details{border:1px solid var(--rule);border-radius:8px;margin:12px 0;padding:0 14px}summary{cursor:pointer;padding:10px 0;
font-weight:600}details[open]{padding-bottom:14px}img{max-width:100%;height:auto;border-radius:4px;display:block}
.row{display:grid;grid-template-columns:repeat(auto-fill,minmax(200px,1fr));gap:10px;margin:8px 0}
.row figure{padding:6px}.right{outline:3px solid var(--c)}.wrong{outline:3px solid var(--b)}
code,pre{font:13px/1.45 ui-monospace,monospace}pre{background:var(--panel);padding:12px;border-radius:8px;overflow:auto}
ul.names{columns:2;font-size:.9rem}@media print{details{break-inside:avoid}}
";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_in_a_name_can_become_markup() {
        let name = "<a href='x'>&\"";
        let cells = table("c", &["h"], &[vec![name, name]]).into_string();
        // In text a single quote is just that, and attributes are in double quotes.
        assert!(
            cells.contains("<td>&lt;a href='x'&gt;&amp;&quot;</td>"),
            "{cells}"
        );
        let attribute = html! { img alt=(name); }.into_string();
        assert_eq!(attribute, "<img alt=\"&lt;a href='x'&gt;&amp;&quot;\">");
        let page = page("<t>", &html! {});
        assert!(page.contains("<title>&lt;t&gt;</title>") && !page.contains("http"));
    }
}
