//! Tables as text, for a terminal.

use comfy_table::{
    CellAlignment, ColumnConstraint, ContentArrangement, Table as Printed, TableStyle, Width,
    presets,
};

use super::Table;

impl Table {
    /// The table in a frame below its caption, in lines of at most `columns` characters. Columns that do not fit follow
    /// below, with the caption and the names of the rows again; long names are wrapped.
    pub fn framed(&self, columns: usize) -> String {
        let parts = self.parts(presets::UTF8_BORDERS_ONLY, 0, columns);
        let titled = parts.iter().enumerate().map(|(number, part)| {
            let continued = if number > 0 { " (continued)" } else { "" };
            format!("{}\n{part}", wrapped(&format!("{}{continued}", self.caption()), columns))
        });
        titled.collect::<Vec<_>>().join("\n")
    }

    /// The same without frame and caption.
    pub fn plain(&self, columns: usize) -> String {
        self.parts(presets::NOTHING, 1, columns).join("\n")
    }

    /// The table in parts, each with the columns that fit beside each other. `padding` at the left of all columns but the first makes
    /// them two characters apart in this style.
    fn parts(&self, style: TableStyle, padding: u16, columns: usize) -> Vec<String> {
        let rows: Vec<Vec<&str>> = self.rows().collect();
        let titles: Vec<&str> = self.header().iter().map(String::as_str).collect();
        let part = |from: usize, to: usize| {
            let mut part = Printed::new();
            part.load_style(style);
            part.set_header(titles.iter().take(1).chain(&titles[from..to]));
            for row in &rows {
                let cells = row.get(from..to.min(row.len())).unwrap_or_default();
                // A row without anything below has been printed above.
                if from == 1 || cells.iter().any(|cell| !cell.is_empty()) {
                    part.add_row(row.iter().take(1).chain(cells));
                }
            }
            for (column, number) in part.column_iter_mut().skip(1).zip(from..) {
                let is_text =
                    rows.iter().filter_map(|row| row.get(number)).any(|cell| is_word(cell));
                let right = CellAlignment::Right;
                column.set_cell_alignment(if is_text { CellAlignment::Left } else { right });
                column.set_padding((padding, 1));
            }
            if let Some(names) = part.column_mut(0) {
                let most = u16::try_from(columns / 2).unwrap_or(u16::MAX).max(1);
                names.set_constraint(ColumnConstraint::UpperBoundary(Width::Fixed(most)));
            }
            part
        };
        let mut parts = Vec::new();
        let mut from = 1.min(titles.len());
        loop {
            let mut to = (from + 1).min(titles.len());
            while to < titles.len() && width(&part(from, to + 1)) <= columns {
                to += 1;
            }
            let mut fitting = part(from, to);
            if width(&fitting) > columns {
                // A single column that is wider than the terminal.
                fitting.set_content_arrangement(ContentArrangement::Dynamic);
                fitting.set_width(u16::try_from(columns).unwrap_or(u16::MAX));
            }
            parts.push(fitting.trim_fmt());
            if to >= titles.len() {
                return parts;
            }
            from = to;
        }
    }
}

/// Whether a cell has words, which are aligned to the left, and no number.
fn is_word(cell: &str) -> bool {
    cell.starts_with(|first: char| first.is_alphabetic() || first == '/') && cell != "NaN"
}

/// Words in lines of at most `columns` characters.
pub fn wrapped(text: &str, columns: usize) -> String {
    let mut lines = String::new();
    let mut length = 0;
    for word in text.split(' ') {
        let word_length = word.chars().count();
        if length > 0 {
            let fits = length + 1 + word_length <= columns;
            lines.push(if fits { ' ' } else { '\n' });
            length = if fits { length + 1 } else { 0 };
        }
        lines.push_str(word);
        length += word_length;
    }
    lines
}

fn width(table: &Printed) -> usize {
    table.lines().map(|line| line.trim_end().chars().count()).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn speeds() -> Table {
        let mut table = Table::new("speed of vehicles", ["", "kind", "m/s", "m/s, uphill"]);
        table.row("a very long name of one of the bicycles", ["cycle", "5.1", "2.25"]);
        table.row("cars", ["car", "33.0", "-"]);
        table
    }

    #[test]
    fn a_table_that_fits_is_one_table_with_numbers_at_the_right() {
        let expected = "\
speed of vehicles
┌───────────────────────────────────────────────────────────────────┐
│                                          kind    m/s  m/s, uphill │
╞═══════════════════════════════════════════════════════════════════╡
│ a very long name of one of the bicycles  cycle   5.1         2.25 │
│ cars                                     car    33.0            - │
└───────────────────────────────────────────────────────────────────┘";
        assert_eq!(speeds().framed(100), expected);
    }

    #[test]
    fn columns_that_do_not_fit_follow_below_and_every_line_fits() {
        for columns in [20, 30, 40, 50, 60, 80] {
            for text in [speeds().framed(columns), speeds().plain(columns)] {
                let widest = text.lines().map(|line| line.chars().count()).max().unwrap();
                assert!(widest <= columns, "{columns}:\n{text}");
                for word in ["cycle", "5.1", "2.25", "33.0", "bicycles"] {
                    assert!(text.contains(word), "{columns}: {word}:\n{text}");
                }
            }
        }
        let narrow = speeds().plain(30);
        assert_eq!(narrow.matches("cars").count(), 2, "{narrow}");
        let narrow = speeds().framed(40);
        assert!(narrow.starts_with("speed of vehicles\n"), "{narrow}");
        assert!(narrow.contains("\nspeed of vehicles (continued)\n"), "{narrow}");
    }

    #[test]
    fn a_table_without_columns_has_its_names() {
        let mut table = Table::new("names", [""]);
        table.row("one", [""; 0]);
        assert!(table.framed(80).contains("one"));
    }
}
