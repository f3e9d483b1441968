//! Pictures in rows and columns.

use base64::{Engine as _, engine::general_purpose::STANDARD};
use maud::{Markup, html};

/// A picture.
#[derive(Clone, Debug)]
pub struct Picture {
    /// The bytes of a PNG.
    pub png: Vec<u8>,
    /// Its size (pixels); shown at half this size, for high-resolution screens and print.
    pub size: [usize; 2],
    /// Alternative text.
    pub words: String,
}

/// Pictures in rows and columns, each with its name.
#[derive(Clone, Debug)]
pub struct PictureGrid {
    /// Caption.
    pub caption: String,
    /// Titles of the columns.
    pub columns: Vec<String>,
    /// Rows with their names.
    pub rows: Vec<(String, Vec<Picture>)>,
}

impl Picture {
    fn markup(&self) -> Markup {
        let [width, height] = self.size.map(|length| length.div_ceil(2));
        let data = format!("data:image/png;base64,{}", STANDARD.encode(&self.png));
        html! { img src=(data) width=(width) height=(height) alt=(self.words); }
    }
}

impl PictureGrid {
    pub(super) fn markup(&self) -> Markup {
        html! {
            figure.pictures {
                div.table tabindex="0" {
                    table {
                        thead {
                            tr {
                                td {}
                                @for column in &self.columns { th scope="col" { (column) } }
                            }
                        }
                        tbody {
                            @for (name, pictures) in &self.rows {
                                tr {
                                    th scope="row" { (name) }
                                    @for picture in pictures { td { (picture.markup()) } }
                                }
                            }
                        }
                    }
                }
                figcaption { (self.caption) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_is_embedded_in_the_page() {
        let picture = Picture { png: vec![1, 2, 3], size: [40, 21], words: "a < b".into() };
        let html = picture.markup().into_string();
        let expected =
            r#"<img src="data:image/png;base64,AQID" width="20" height="11" alt="a &lt; b">"#;
        assert_eq!(html, expected);
    }
}
