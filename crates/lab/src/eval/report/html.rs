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

const STYLE: &str = include_str!("style.css");

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
