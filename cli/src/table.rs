//! Tables and texts for people.

use unicode_width::UnicodeWidthStr as _;

/// Columns of a terminal that a table takes unless all of it is asked for.
pub(crate) const WIDTH: usize = 120;
/// Columns between two cells.
const GAP: usize = 2;
/// The last column is wrapped at no less than this.
const LAST_MIN: usize = 40;

/// A table with a heading; every column as wide as its longest cell, the text of the last one wrapped.
pub(crate) struct Table {
    rows: Vec<Vec<String>>,
    /// `None`: as wide as its cells are.
    width: Option<usize>,
}

impl Table {
    /// A table that has only its heading.
    pub(crate) fn new<const N: usize>(heading: [&str; N]) -> Self {
        Self { rows: vec![heading.map(str::to_owned).to_vec()], width: Some(WIDTH) }
    }

    /// The same table, its lines as long as its cells make them if `is_wide`.
    pub(crate) fn wide(mut self, is_wide: bool) -> Self {
        self.width = self.width.filter(|_| !is_wide);
        self
    }

    /// One more row. Line ends in the last cell are kept.
    pub(crate) fn row<const N: usize>(&mut self, cells: [String; N]) {
        self.rows.push(cells.to_vec());
    }

    /// The lines of the table.
    pub(crate) fn text(&self) -> String {
        let columns = self.rows[0].len();
        let rows: Vec<Vec<String>> = self.rows.iter().map(|row| cleaned(row)).collect();
        let width = |column: usize| rows.iter().map(|row| row[column].width()).max().unwrap_or(0);
        let widths: Vec<_> = (0..columns - 1).map(width).collect();
        let before: usize = widths.iter().map(|width| width + GAP).sum();
        let room = self.width.map_or(usize::MAX, |all| all.saturating_sub(before).max(LAST_MIN));
        rows.iter().map(|row| lines(row, &widths, room)).collect()
    }
}

/// The cells of a row as they are shown; of the last one each line by itself.
fn cleaned(row: &[String]) -> Vec<String> {
    let last = row.len() - 1;
    let cell = |(at, cell): (usize, &String)| {
        if at < last { clean(cell) } else { cell.lines().map(clean).collect::<Vec<_>>().join("\n") }
    };
    row.iter().enumerate().map(cell).collect()
}

/// The lines of one row: its last cell is wrapped at `room`, and continues below itself.
fn lines(row: &[String], widths: &[usize], room: usize) -> String {
    let Some((last, cells)) = row.split_last() else { return String::new() };
    let padded = |(cell, width): (&String, &usize)| {
        let fill = width.saturating_sub(cell.width()) + GAP;
        format!("{cell}{}", " ".repeat(fill))
    };
    let mut head: String = cells.iter().zip(widths).map(padded).collect();
    let mut text = String::new();
    let wrapped: Vec<_> = last.lines().flat_map(|line| wrapped(line, room)).collect();
    for line in wrapped.iter().map(String::as_str).chain(wrapped.is_empty().then_some("")) {
        text += format!("{head}{line}").trim_end();
        text.push('\n');
        head = " ".repeat(head.width());
    }
    text
}

/// A line in parts of at most `room` columns, parted between words.
fn wrapped(line: &str, room: usize) -> Vec<String> {
    let mut parts: Vec<String> = Vec::new();
    for word in line.split(' ') {
        match parts.last_mut() {
            Some(part) if part.width() + 1 + word.width() <= room => {
                part.push(' ');
                part.push_str(word);
            }
            Some(_) | None => parts.push(word.to_owned()),
        }
    }
    parts
}

/// A text of another program, each character that would move the cursor, forge a line or hide as its escape.
pub(crate) fn clean(text: &str) -> String {
    sinew::name::shown(text)
}

/// One word for the shell.
pub(crate) fn quoted(word: &str) -> String {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "/._-".contains(sign);
    if word.chars().all(is_plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

/// A time in the unit that suits it, from microseconds.
pub(crate) fn time(micros: u64) -> String {
    let seconds = micros / 1_000_000;
    match seconds {
        0 if micros < 1_000 => format!("{micros} us"),
        0 => format!("{:.1} ms", micros as f64 / 1e3),
        1..60 => format!("{:.1} s", micros as f64 / 1e6),
        60..3_600 => format!("{} min {} s", seconds / 60, seconds % 60),
        3_600..86_400 => format!("{} h {} min", seconds / 3_600, seconds % 3_600 / 60),
        _ => format!("{} d {} h", seconds / 86_400, seconds % 86_400 / 3_600),
    }
}

/// What is known, or a dash.
pub(crate) fn or_dash(text: Option<String>) -> String {
    text.unwrap_or_else(|| "-".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_column_is_as_wide_as_its_longest_cell_on_the_screen_and_a_foreign_text_forges_no_line() {
        let mut table = Table::new(["name", "state", "what"]);
        table.row(["膝".to_owned(), "a\nb".to_owned(), "x\u{202e}y".to_owned()]);
        table.row(["knee".to_owned(), "c".to_owned(), "z".to_owned()]);
        let lines = "name  state    what\n膝    a\\u{a}b  x\\u{202e}y\nknee  c        z\n";
        assert_eq!(table.text(), lines);
    }

    #[test]
    fn the_last_column_is_wrapped_between_words_below_itself_unless_all_is_asked_for() {
        let words = ["word"; 40].join(" ");
        let mut table = Table::new(["step", "detail"]);
        table.row(["knee".to_owned(), format!("{words}\nits second line")]);
        let text = table.text();
        assert!(text.lines().all(|line| line.width() <= WIDTH), "{text}");
        assert_eq!(text.matches("word").count(), 40);
        assert!(text.ends_with("\n      its second line\n"), "{text}");
        assert!(table.wide(true).text().contains(&words));
    }

    #[test]
    fn times_are_told_in_the_unit_that_suits_them() {
        let told = [7, 1_500, 2_500_000, 61_000_000, 3_660_000_000, 90_000_000_000].map(time);
        assert_eq!(told, ["7 us", "1.5 ms", "2.5 s", "1 min 1 s", "1 h 1 min", "1 d 1 h"]);
    }
}
