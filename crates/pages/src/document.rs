//! A page and its sections.

use std::{fs, io, path::Path};

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::{LinePlot, PictureGrid, Provenance, Table};

/// Style sheet for screen and print.
const STYLE: &str = include_str!("page.css");
/// Hover values and sorting of tables.
const SCRIPT: &str = include_str!("page.js");

/// A page: title, introduction and sections.
#[derive(Clone, Debug)]
pub struct Page {
    title: String,
    lead: String,
    sections: Vec<Section>,
}

/// A section of a page, with its content in the order in which it was added.
#[derive(Clone, Debug)]
pub struct Section {
    title: String,
    content: Vec<Part>,
}

/// A part of a section.
#[derive(Clone, Debug)]
struct Part {
    markup: Markup,
    /// Whether it introduces what follows, like a heading or a paragraph: a printed page does not end with it.
    introduces: bool,
}

impl Page {
    /// A page without sections. `lead` introduces it in a sentence or two.
    pub fn new(title: impl Into<String>, lead: impl Into<String>) -> Self {
        Self { title: title.into(), lead: lead.into(), sections: Vec::new() }
    }

    /// Appends an empty section.
    pub fn section(&mut self, title: impl Into<String>) -> &mut Section {
        self.sections.push(Section::new(title.into()));
        let last = self.sections.len() - 1;
        &mut self.sections[last]
    }

    /// The page as HTML.
    pub fn html(&self) -> String {
        let markup = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    meta name="color-scheme" content="light dark";
                    meta name="generator" content=(concat!("eddy ", env!("CARGO_PKG_VERSION")));
                    title { (self.title) }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    header {
                        h1 { (self.title) }
                        p.lead { (self.lead) }
                    }
                    @if self.sections.len() > 1 {
                        nav aria-label="Contents" {
                            ol {
                                @for (number, section) in self.sections.iter().enumerate() {
                                    li { a href={ "#" (identifier(number)) } { (section.title) } }
                                }
                            }
                        }
                    }
                    main {
                        @for (number, section) in self.sections.iter().enumerate() {
                            section id=(identifier(number)) {
                                (kept_together(Some(html! { h2 { (section.title) } }), &section.content))
                            }
                        }
                    }
                    script { (PreEscaped(SCRIPT)) }
                }
            }
        };
        markup.into_string()
    }

    /// Writes the page to a file.
    ///
    /// # Errors
    /// I/O errors.
    pub fn save(&self, path: &Path) -> io::Result<()> {
        fs::write(path, self.html())
    }
}

/// The anchor of a section.
fn identifier(number: usize) -> String {
    format!("section-{}", number + 1)
}

/// The parts of a section. What introduces the next table or figure is in one element with it, which printed pages do not
/// break.
fn kept_together(heading: Option<Markup>, parts: &[Part]) -> Markup {
    let mut open: Vec<Markup> = heading.into_iter().collect();
    let mut all = Vec::new();
    for Part { markup, introduces } in parts {
        if *introduces {
            open.push(markup.clone());
        } else if open.is_empty() {
            all.push(markup.clone());
        } else {
            let introduction = std::mem::take(&mut open);
            all.push(html! { div.keep { @for part in &introduction { (part) } (markup) } });
        }
    }
    all.append(&mut open);
    html! { @for part in &all { (part) } }
}

impl Section {
    fn new(title: String) -> Self {
        Self { title, content: Vec::new() }
    }

    /// A heading within the section.
    pub fn heading(&mut self, words: &str) -> &mut Self {
        self.introduce(html! { h3 { (words) } })
    }

    /// A paragraph.
    pub fn paragraph(&mut self, words: &str) -> &mut Self {
        self.introduce(html! { p { (words) } })
    }

    /// A highlighted paragraph.
    pub fn note(&mut self, words: &str) -> &mut Self {
        self.introduce(html! { p.note { (words) } })
    }

    /// Preformatted lines.
    pub fn code(&mut self, lines: &str) -> &mut Self {
        self.add(html! { pre { code { (lines) } } })
    }

    /// A table.
    pub fn table(&mut self, table: &Table) -> &mut Self {
        self.add(table.markup())
    }

    /// Plots, side by side where the page is wide enough. Empty plots are omitted; a legend that is the same for all is
    /// shown once.
    pub fn plots(&mut self, plots: &[LinePlot]) -> &mut Self {
        match LinePlot::figures(plots) {
            Some(figures) => self.add(figures),
            None => self,
        }
    }

    /// Pictures in rows and columns.
    pub fn pictures(&mut self, grid: &PictureGrid) -> &mut Self {
        self.add(grid.markup())
    }

    /// A description list.
    pub fn facts(&mut self, facts: &[(String, String)]) -> &mut Self {
        self.add(html! {
            dl {
                @for (name, value) in facts {
                    div { dt { (name) } dd { (value) } }
                }
            }
        })
    }

    /// The command that made the page, version, machine and date.
    pub fn provenance(&mut self, made: &Provenance) -> &mut Self {
        self.code(&made.command).facts(&made.facts())
    }

    /// A part that is collapsed on screen and expanded in print.
    pub fn folded(&mut self, summary: &str, fill: impl FnOnce(&mut Self)) -> &mut Self {
        let mut inner = Self::new(String::new());
        fill(&mut inner);
        self.add(html! {
            details { summary { (summary) } (kept_together(None, &inner.content)) }
        })
    }

    fn add(&mut self, markup: Markup) -> &mut Self {
        self.content.push(Part { markup, introduces: false });
        self
    }

    fn introduce(&mut self, markup: Markup) -> &mut Self {
        self.content.push(Part { markup, introduces: true });
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every character with a meaning in HTML.
    const EVIL: &str = r#"<script>alert('x')</script> & "y""#;

    #[test]
    fn all_text_is_escaped() {
        let mut page = Page::new(EVIL, EVIL);
        let section = page.section(EVIL);
        section.heading(EVIL).paragraph(EVIL).note(EVIL).code(EVIL);
        section.facts(&[(EVIL.into(), EVIL.into())]).folded(EVIL, |inner| {
            inner.paragraph(EVIL);
        });
        let mut table = Table::new(EVIL, [EVIL, EVIL]);
        table.row(EVIL, [EVIL]);
        section.table(&table);
        let html = page.html();
        assert!(html.matches("<script").count() == 1 && !html.contains("alert('x')</"), "{html}");
        assert!(html.matches("&lt;script&gt;").count() >= 13, "{html}");
    }

    #[test]
    fn a_page_has_no_external_resources() {
        let mut page = Page::new("a", "b");
        page.section("c").paragraph("d");
        page.section("e").note("f");
        let html = page.html();
        for word in ["http:", "https:", "src=", "@import", "url(", "<link", "fetch(", "import("] {
            assert!(!html.contains(word), "found {word}");
        }
        assert!(html.contains(r##"<a href="#section-2">e</a>"##), "{html}");
        assert!(html.contains(r#"<section id="section-2"><h2>e</h2>"#), "{html}");
    }

    #[test]
    fn an_introduction_is_kept_together_with_what_it_introduces() {
        let mut page = Page::new("a", "b");
        let section = page.section("c");
        section.paragraph("d").code("e").code("f").heading("g").note("h").code("i").paragraph("j");
        let html = page.html();
        let expected = concat!(
            r#"<section id="section-1"><div class="keep"><h2>c</h2><p>d</p><pre><code>e</code></pre></div>"#,
            r#"<pre><code>f</code></pre><div class="keep"><h3>g</h3><p class="note">h</p>"#,
            r#"<pre><code>i</code></pre></div><p>j</p></section>"#,
        );
        assert!(html.contains(expected), "{html}");
    }

    #[test]
    fn the_same_page_is_the_same_bytes() {
        let page = || {
            let mut page = Page::new("a", "b");
            page.section("c").plots(&[LinePlot::default()]);
            page.html()
        };
        assert_eq!(page(), page());
    }
}
