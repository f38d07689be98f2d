//! The lines of all tables, as the terminal and the plain text show them. Pure.

use super::model::{Model, Row};
use crate::table::Table;

/// A line, and its role.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Line {
    pub(super) text: String,
    pub(super) role: Role,
}

/// The role of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Title,
    Heading,
    /// A row in order.
    Fine,
    /// A row with a finding.
    Finding,
    Blank,
}

/// Returns the tables one below the other. Of each only the rows that contain the text `filter`, in any case. A table
/// without rows is left out.
pub(super) fn lines(model: &Model, filter: &str) -> Vec<Line> {
    let filter = filter.to_lowercase();
    let mut lines = Vec::new();
    for section in &model.sections {
        let rows: Vec<_> = section.rows.iter().filter(|row| is_shown(row, &filter)).collect();
        if rows.is_empty() {
            continue;
        }
        let mut table = Table::of(&section.heading()).wide(true);
        rows.iter().for_each(|row| table.add(&row.texts()));
        if !lines.is_empty() {
            lines.push(Line { text: String::new(), role: Role::Blank });
        }
        lines.push(Line { text: section.title.to_owned(), role: Role::Title });
        let role = |row: &Row| if row.is_fine { Role::Fine } else { Role::Finding };
        let roles = [Role::Heading].into_iter().chain(rows.into_iter().map(role));
        // No cell has a line end: each row is one line.
        let text = table.text();
        lines.extend(text.lines().zip(roles).map(|(text, role)| Line { text: text.to_owned(), role }));
    }
    lines
}

fn is_shown(row: &Row, filter: &str) -> bool {
    filter.is_empty() || row.texts().iter().any(|cell| cell.to_lowercase().contains(filter))
}

#[cfg(test)]
mod tests {
    use super::{
        super::model::{Cell, Section},
        *,
    };

    fn model() -> Model {
        let row = |name: &str, is_fine| Row {
            cells: vec![Cell::Text(name.to_owned()), Cell::Text("hip\nforged".to_owned()), Cell::Rate(123.4)],
            is_fine,
        };
        const COLUMNS: &[(&str, &str)] = &[("NAME", "name"), ("NODE", "node"), ("IN/S", "in_per_s")];
        let section = |title, rows| Section::for_test(title, COLUMNS, rows);
        let sections = vec![
            section("Nodes", Vec::new()),
            section("Applications", vec![row("Drive", true), row("gait", false)]),
            section("Links", vec![row("knee", true)]),
        ];
        Model { sections, fault: None, left_out: 0 }
    }

    fn texts(lines: &[Line]) -> Vec<&str> {
        lines.iter().map(|line| line.text.as_str()).collect()
    }

    #[test]
    fn tables_with_rows_are_below_each_other() {
        let lines = lines(&model(), "");
        let expected = [
            "Applications",
            "NAME   NODE              IN/S",
            "Drive  hip\\u{a}forged  123",
            "gait   hip\\u{a}forged  123",
            "",
            "Links",
            "NAME  NODE              IN/S",
            "knee  hip\\u{a}forged  123",
        ];
        let in_one_space = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
        let shown: Vec<_> = texts(&lines).into_iter().map(in_one_space).collect();
        assert_eq!(shown, expected.map(in_one_space));
        let roles: Vec<_> = lines.iter().map(|line| line.role).take(5).collect();
        assert_eq!(roles, [Role::Title, Role::Heading, Role::Fine, Role::Finding, Role::Blank]);
    }

    #[test]
    fn filter_keeps_rows_with_its_text() {
        let drives = lines(&model(), "dRIV");
        assert_eq!((drives.len(), drives[0].text.as_str()), (3, "Applications"));
        assert!(drives[2].text.starts_with("Drive"), "{drives:?}");
        assert!(lines(&model(), "no such text").is_empty());
    }
}
