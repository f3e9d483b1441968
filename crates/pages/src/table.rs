//! Tables with a caption.

use maud::{Markup, html};

/// A table. The first column names the rows; the others are right-aligned.
#[derive(Clone, Debug)]
pub struct Table {
    caption: String,
    header: Vec<String>,
    rows: Vec<Row>,
}

/// A row with its name.
#[derive(Clone, Debug)]
struct Row {
    name: Cell,
    cells: Vec<Cell>,
    order: RowOrder,
}

/// Where a row is in a table that a reader has sorted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RowOrder {
    /// Sorted.
    Sorted,
    /// Stays in its place.
    Fixed,
    /// Stays below the row above it.
    Detail,
}

/// A cell of a table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cell {
    text: String,
    bold: bool,
}

impl Cell {
    /// A bold cell.
    pub fn bold(text: impl Into<String>) -> Self {
        Self { text: text.into(), bold: true }
    }

    /// A cell for each number, the lowest in bold; `-` for NaN.
    pub fn lowest_bold(numbers: &[f64], format: impl Fn(f64) -> String) -> Vec<Self> {
        let lowest = numbers.iter().copied().fold(f64::INFINITY, f64::min);
        let cell = |&number: &f64| match number {
            number if number.is_nan() => "-".into(),
            number => Self { text: format(number), bold: number == lowest },
        };
        numbers.iter().map(cell).collect()
    }
}

impl<T: Into<String>> From<T> for Cell {
    fn from(text: T) -> Self {
        Self { text: text.into(), bold: false }
    }
}

impl Table {
    /// A table without rows; `header` names every column, including the first.
    pub fn new<T: Into<String>>(
        caption: impl Into<String>,
        header: impl IntoIterator<Item = T>,
    ) -> Self {
        let header = header.into_iter().map(Into::into).collect();
        Self { caption: caption.into(), header, rows: Vec::new() }
    }

    /// Appends a row.
    pub fn row<C: Into<Cell>>(
        &mut self,
        name: impl Into<Cell>,
        cells: impl IntoIterator<Item = C>,
    ) -> &mut Self {
        self.add(name.into(), cells, RowOrder::Sorted)
    }

    /// Appends a row that stays in its place when a reader sorts the table, such as a row of averages.
    pub fn fixed_row<C: Into<Cell>>(
        &mut self,
        name: impl Into<Cell>,
        cells: impl IntoIterator<Item = C>,
    ) -> &mut Self {
        self.add(name.into(), cells, RowOrder::Fixed)
    }

    /// Appends a row that belongs to the one above it, such as its intervals.
    pub fn detail_row<C: Into<Cell>>(
        &mut self,
        name: impl Into<Cell>,
        cells: impl IntoIterator<Item = C>,
    ) -> &mut Self {
        self.add(name.into(), cells, RowOrder::Detail)
    }

    fn add<C: Into<Cell>>(
        &mut self,
        name: Cell,
        cells: impl IntoIterator<Item = C>,
        order: RowOrder,
    ) -> &mut Self {
        self.rows.push(Row { name, cells: cells.into_iter().map(Into::into).collect(), order });
        self
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The caption.
    pub fn caption(&self) -> &str {
        &self.caption
    }

    /// Titles of the columns, including the first.
    pub fn header(&self) -> &[String] {
        &self.header
    }

    /// The table as Markdown, below its caption.
    pub fn markdown(&self) -> String {
        let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
        let escaped = |text: &str| text.replace('|', "\\|");
        let word = |cell: &Cell| match cell.bold {
            true => format!("**{}**", escaped(&cell.text)),
            false => escaped(&cell.text),
        };
        let mut text = format!("{}:\n\n", escaped(&self.caption));
        text.push_str(&line(self.header.iter().map(|title| escaped(title)).collect()));
        let ruler = (0..self.header.len()).map(|column| if column == 0 { "---" } else { "---:" });
        text.push_str(&line(ruler.map(str::to_owned).collect()));
        for Row { name, cells, .. } in &self.rows {
            text.push_str(&line([name].into_iter().chain(cells).map(word).collect()));
        }
        text
    }

    /// The text of each row, including its name.
    pub fn rows(&self) -> impl Iterator<Item = Vec<&str>> {
        self.rows.iter().map(|Row { name, cells, .. }| {
            std::iter::once(name).chain(cells).map(|cell| cell.text.as_str()).collect()
        })
    }

    pub(super) fn markup(&self) -> Markup {
        html! {
            // Scrolls horizontally where the page is too narrow.
            div.table tabindex="0" {
                table {
                    caption { (self.caption) }
                    thead { tr { @for title in &self.header { th scope="col" { (title) } } } }
                    tbody {
                        @for Row { name, cells, order } in &self.rows {
                            tr class=[order.class()] {
                                th scope="row" {
                                    @if name.bold { b { (name.text) } } @else { (name.text) }
                                }
                                @for cell in cells {
                                    td { @if cell.bold { b { (cell.text) } } @else { (cell.text) } }
                                }
                                @for _ in cells.len() + 1..self.header.len() { td {} }
                            }
                        }
                    }
                }
            }
        }
    }
}

impl RowOrder {
    /// Class of the row, for `page.js`.
    fn class(self) -> Option<&'static str> {
        match self {
            Self::Sorted => None,
            Self::Fixed => Some("fixed"),
            Self::Detail => Some("detail"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_that_are_not_sorted_say_so() {
        let mut table = Table::new("speeds", ["what", "ms"]);
        table.fixed_row("scenes", ["3"]).row("fast", ["1"]).detail_row("interval", ["0 to 2"]);
        let html = table.markup().into_string();
        assert!(html.contains(r#"<tr class="fixed"><th scope="row">scenes"#), "{html}");
        assert!(html.contains(r#"<tr><th scope="row">fast"#), "{html}");
        assert!(html.contains(r#"<tr class="detail"><th scope="row">interval"#), "{html}");
    }

    #[test]
    fn the_lowest_numbers_are_bold_and_nan_is_a_dash() {
        let cells = Cell::lowest_bold(&[2.0, f64::NAN, 1.0, 1.0], |x| format!("{x:.1}"));
        assert_eq!(cells, ["2.0".into(), "-".into(), Cell::bold("1.0"), Cell::bold("1.0")]);
        assert_eq!(Cell::lowest_bold(&[f64::NAN], |x| x.to_string()), ["-".into()]);
    }

    #[test]
    fn a_table_has_its_caption_titles_and_rows() {
        let mut table = Table::new("speeds", ["what", "ms"]);
        table.row("slow", [Cell::bold("3")]).row("fast", ["1"]).row("none", [""; 0]);
        assert_eq!(
            table.rows().collect::<Vec<_>>(),
            [vec!["slow", "3"], vec!["fast", "1"], vec!["none"]]
        );
        let expected = concat!(
            r#"<div class="table" tabindex="0"><table><caption>speeds</caption><thead><tr>"#,
            r#"<th scope="col">what</th><th scope="col">ms</th></tr></thead><tbody>"#,
            r#"<tr><th scope="row">slow</th><td><b>3</b></td></tr>"#,
            r#"<tr><th scope="row">fast</th><td>1</td></tr>"#,
            r#"<tr><th scope="row">none</th><td></td></tr></tbody></table></div>"#,
        );
        assert_eq!(table.markup().into_string(), expected);
    }
}
