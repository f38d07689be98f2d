//! Tables and texts for users.

use unicode_width::{UnicodeWidthChar as _, UnicodeWidthStr};

/// Maximum terminal columns of a table, unless it is wide.
pub(crate) const WIDTH: usize = 120;
/// Columns between two cells.
const GAP: usize = 2;
/// Minimum width of a column.
const COLUMN_MIN: usize = 4;

/// A table with a heading. Each column is as wide as its longest cell; if the table is too wide for a terminal, the
/// widest columns are wrapped.
pub(crate) struct Table {
    rows: Vec<Vec<String>>,
    /// `None`: as wide as its cells are.
    width: Option<usize>,
    /// Columns that are wrapped last, by their headings, because users copy their cells.
    whole: &'static [&'static str],
}

impl Table {
    /// A table that has only its heading.
    pub(crate) fn new<const N: usize>(heading: [&str; N]) -> Self {
        Self { rows: vec![heading.map(str::to_owned).to_vec()], width: Some(WIDTH), whole: &[] }
    }

    /// A table that has only its heading, with as many columns as it has.
    pub(crate) fn of(heading: &[&str]) -> Self {
        let heading = heading.iter().map(|&cell| cell.to_owned()).collect();
        Self { rows: vec![heading], width: Some(WIDTH), whole: &[] }
    }

    /// Returns the same table with unlimited line length if `is_wide`.
    pub(crate) fn wide(mut self, is_wide: bool) -> Self {
        self.width = self.width.filter(|_| !is_wide);
        self
    }

    /// Returns the same table, in which the columns with these headings are wrapped last.
    pub(crate) fn whole(mut self, headings: &'static [&'static str]) -> Self {
        self.whole = headings;
        self
    }

    /// One more row. Line ends in the last cell are kept.
    pub(crate) fn row<const N: usize>(&mut self, cells: [String; N]) {
        self.rows.push(cells.to_vec());
    }

    /// One more row, with as many cells as the heading has.
    pub(crate) fn add(&mut self, cells: &[String]) {
        self.rows.push(cells.to_vec());
    }

    /// The lines of the table.
    pub(crate) fn text(&self) -> String {
        let rows: Vec<Vec<String>> = self.rows.iter().map(|row| cleaned(row)).collect();
        let widest = |cell: &String| cell.lines().map(UnicodeWidthStr::width).max().unwrap_or(0);
        let columns = self.rows[0].len();
        let width = |column: usize| rows.iter().map(|row| widest(&row[column])).max().unwrap_or(0);
        let mut widths: Vec<_> = (0..columns).map(width).collect();
        if let Some(all) = self.width {
            let room = all.saturating_sub(GAP * (columns - 1));
            let is_whole = |column: usize| self.whole.contains(&self.rows[0][column].as_str());
            let narrowed: Vec<_> = (0..columns).filter(|column| !is_whole(*column)).collect();
            narrow(&mut widths, &narrowed, room);
            narrow(&mut widths, &(0..columns).collect::<Vec<_>>(), room);
        }
        rows.iter().map(|row| lines(row, &widths)).collect()
    }
}

/// Narrows the widest of these columns until all columns fit or none is wider than the others.
fn narrow(widths: &mut [usize], columns: &[usize], room: usize) {
    let all: usize = widths.iter().sum();
    let own: usize = columns.iter().map(|column| widths[*column]).sum();
    let own_room = room.saturating_sub(all - own);
    let capped = |cap: usize| columns.iter().map(|column| widths[*column].min(cap)).sum::<usize>();
    let widest = columns.iter().map(|column| widths[*column]).max().unwrap_or(0);
    let cap =
        (COLUMN_MIN..=widest.min(own_room)).rev().find(|cap| capped(*cap) <= own_room).unwrap_or(COLUMN_MIN);
    let mut left = own_room.saturating_sub(capped(cap));
    for column in columns {
        let width = &mut widths[*column];
        // The remainder of the division goes to the first ones.
        let more = usize::from(*width > cap && left > 0);
        left -= more;
        *width = (*width).min(cap + more);
    }
}

/// Returns the cells of a row as displayed; the last one is split into its lines.
fn cleaned(row: &[String]) -> Vec<String> {
    let last = row.len() - 1;
    let cell = |(at, cell): (usize, &String)| {
        if at < last { clean(cell) } else { clean_lines(cell) }
    };
    row.iter().enumerate().map(cell).collect()
}

/// Returns the lines of one row: each cell is wrapped at the width of its column, and continues below itself.
pub(crate) fn lines(row: &[String], widths: &[usize]) -> String {
    let wrap = |(cell, width): (&String, &usize)| {
        cell.lines().flat_map(|line| wrapped(line, *width)).collect::<Vec<_>>()
    };
    let cells: Vec<_> = row.iter().zip(widths).map(wrap).collect();
    let height = cells.iter().map(Vec::len).max().unwrap_or(0).max(1);
    let mut text = String::new();
    for at in 0..height {
        let mut line = String::new();
        for (cell, width) in cells.iter().zip(widths) {
            let part = cell.get(at).map_or("", String::as_str);
            line += part;
            line += &" ".repeat(width.saturating_sub(part.width()) + GAP);
        }
        text += line.trim_end();
        text.push('\n');
    }
    text
}

/// Returns a line of text, wrapped at [`WIDTH`] unless `is_wide`; continuation lines are indented slightly more than
/// the first.
pub(crate) fn paragraph(indent: usize, line: &str, is_wide: bool) -> String {
    let room = if is_wide { usize::MAX } else { WIDTH.saturating_sub(indent + GAP) };
    let parts = wrapped(line, room).into_iter().enumerate();
    parts.map(|(at, part)| format!("{}{part}\n", " ".repeat(indent + if at > 0 { GAP } else { 0 }))).collect()
}

/// Splits a line into parts of at most `room` columns, between words if these fit.
fn wrapped(line: &str, room: usize) -> Vec<String> {
    let mut parts: Vec<String> = Vec::new();
    for word in line.split(' ') {
        match parts.last_mut() {
            Some(part) if part.width() + 1 + word.width() <= room => {
                part.push(' ');
                part.push_str(word);
            }
            Some(_) | None => parts.extend(cut(word, room)),
        }
    }
    parts
}

/// Splits a word into pieces of at most `room` columns.
fn cut(word: &str, room: usize) -> Vec<String> {
    let mut pieces = vec![String::new()];
    let mut width = 0;
    for character in word.chars() {
        let wide = character.width().unwrap_or(0);
        if width + wide > room && width > 0 {
            pieces.push(String::new());
            width = 0;
        }
        width += wide;
        if let Some(piece) = pieces.last_mut() {
            piece.push(character);
        }
    }
    pieces
}

/// Returns the start of a text from another program, for a quotation in a message.
pub(crate) fn short(text: &str) -> String {
    const QUOTED_MAX: usize = 80;
    let text = clean(text);
    match text.char_indices().nth(QUOTED_MAX) {
        Some((end, _)) => format!("{}...", &text[..end]),
        None => text,
    }
}

/// Returns a text from another program, with escapes for each character that would move the cursor, forge a line or be
/// invisible.
pub(crate) fn clean(text: &str) -> String {
    sinew::name::shown(text)
}

/// Same as [`clean`], but keeps the lines of the text.
pub(crate) fn clean_lines(text: &str) -> String {
    text.lines().map(clean).collect::<Vec<_>>().join("\n")
}

/// Quotes one word for the shell.
pub(crate) fn quoted(word: &str) -> String {
    let is_plain = |sign: char| sign.is_ascii_alphanumeric() || "/._-".contains(sign);
    if word.chars().all(is_plain) { word.to_owned() } else { format!("'{}'", word.replace('\'', r"'\''")) }
}

/// Returns a time given in microseconds, in a suitable unit.
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

/// Returns the text, or a dash for an unknown one.
pub(crate) fn or_dash(text: Option<String>) -> String {
    text.unwrap_or_else(|| "-".to_owned())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns the columns of the longest line.
    pub(crate) fn widest(text: &str) -> usize {
        text.lines().map(UnicodeWidthStr::width).max().unwrap_or(0)
    }

    /// A name of the maximum length.
    pub(crate) fn long_name() -> String {
        "left-knee.".repeat(7).chars().take(63).collect()
    }

    #[test]
    fn columns_fit_cells_and_control_characters_are_escaped() {
        let mut table = Table::new(["name", "state", "what"]);
        table.row(["膝".to_owned(), "a\nb".to_owned(), "x\u{202e}y".to_owned()]);
        table.row(["knee".to_owned(), "c".to_owned(), "z".to_owned()]);
        let lines = "name  state    what\n膝    a\\u{a}b  x\\u{202e}y\nknee  c        z\n";
        assert_eq!(table.text(), lines);
    }

    #[test]
    fn last_column_wraps_between_words_unless_wide() {
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
    fn table_fits_a_terminal_and_keeps_all_text() {
        for lengths in [[63, 63, 63, 63], [1, 63, 63, 400], [400, 400, 400, 400], [120, 0, 3, 0]] {
            let mut table = Table::new(["TID", "NAME", "NODE", "DETAIL"]).whole(&["TID"]);
            table.row(lengths.map(|length| "k".repeat(length)));
            let text = table.text();
            assert!(widest(&text) <= WIDTH, "{text}");
            assert_eq!(text.matches('k').count(), lengths.iter().sum::<usize>(), "{text}");
        }
        let mut table = Table::new(["NUMBER", "NAME", "DETAIL"]).whole(&["NUMBER"]);
        table.row(["1".repeat(40), "膝".repeat(60), "words ".repeat(30)]);
        let text = table.text();
        assert!(widest(&text) <= WIDTH && text.contains(&"1".repeat(40)), "{text}");
        assert_eq!(text.matches('膝').count(), 60);
    }

    #[test]
    fn paragraph_continues_with_an_indent() {
        let text = paragraph(3, &"word ".repeat(60), false);
        assert!(widest(&text) <= WIDTH && text.lines().count() > 2, "{text}");
        assert!(text.lines().skip(1).all(|line| line.starts_with("     ")), "{text}");
        assert_eq!(paragraph(3, &"word ".repeat(60), true).lines().count(), 1);
    }

    #[test]
    fn times_are_shown_in_a_suitable_unit() {
        let texts = [7, 1_500, 2_500_000, 61_000_000, 3_660_000_000, 90_000_000_000].map(time);
        assert_eq!(texts, ["7 us", "1.5 ms", "2.5 s", "1 min 1 s", "1 h 1 min", "1 d 1 h"]);
    }
}
