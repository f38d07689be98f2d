//! Files of the documents that are generated from the code: a test compares them, or writes them anew.

use std::path::PathBuf;

/// The comments around the generated part of a page.
const MARKERS: [&str; 2] = ["<!-- generated: begin -->", "<!-- generated: end -->"];
/// If this variable is set, files are written instead of compared.
const UPDATE: &str = "UPDATE";
/// Limits of a cell of a generated table. A longer one is hard to read.
const CELL_WORDS_MAX: usize = 25;
const CELL_BYTES_MAX: usize = 200;

/// A file that is generated as a whole, or in a part between two comments.
#[derive(Clone, Debug)]
pub struct GeneratedFile {
    path: PathBuf,
    command: &'static str,
}

impl GeneratedFile {
    /// Names a file, and the command that writes it anew.
    #[must_use]
    pub fn new(path: impl Into<PathBuf>, command: &'static str) -> Self {
        Self { path: path.into(), command }
    }

    /// Returns the content.
    ///
    /// # Panics
    /// If the file cannot be read.
    #[must_use]
    pub fn read(&self) -> String {
        std::fs::read_to_string(&self.path).unwrap_or_else(|error| panic!("{}: {error}", self.path.display()))
    }

    /// Checks that the content is this text.
    ///
    /// # Panics
    /// If it is another one.
    #[track_caller]
    pub fn check(&self, expected: &str) {
        self.check_by(expected, |content| content == expected);
    }

    /// Checks that the part of the page between the two comments is this text.
    ///
    /// # Panics
    /// If it is another one, or a comment is missing.
    #[track_caller]
    pub fn check_part(&self, part: &str) {
        let page = self.read();
        let (before, rest) = page.split_once(MARKERS[0]).expect("the generated part begins");
        let (_, after) = rest.split_once(MARKERS[1]).expect("the generated part ends");
        self.check(&[before, MARKERS[0], "\n", part, MARKERS[1], after].concat());
    }

    /// Checks the content by a function, for a format in which several texts are equal.
    ///
    /// # Panics
    /// If the function returns `false`.
    #[track_caller]
    pub fn check_by(&self, expected: &str, is_equal: impl FnOnce(&str) -> bool) {
        let path = self.path.display();
        if std::env::var_os(UPDATE).is_some() {
            std::fs::write(&self.path, expected).unwrap_or_else(|error| panic!("{path}: {error}"));
        }
        let content = self.read();
        let differs = expected.lines().zip(content.lines()).find(|(is, shown)| is != shown);
        let command = self.command;
        assert!(is_equal(&content), "{path} is another text, first in {differs:?}; write it anew: {command}");
    }
}

/// Checks the two texts of a row of a generated table: each is one short sentence, and the second one may be missing.
///
/// # Panics
/// If one of them is longer, or no sentence.
#[track_caller]
pub fn check_cells(row: &str, effect: &str, note: &str) {
    assert!(!effect.is_empty(), "{row} has no effect");
    for sentence in [effect, note] {
        let words = sentence.split_whitespace().count();
        let is_short = words <= CELL_WORDS_MAX && sentence.len() <= CELL_BYTES_MAX;
        assert!(is_short, "{row}, {words} words: {sentence}");
        let is_sentence = sentence.is_empty() || sentence.ends_with('.') && !sentence.contains('|');
        assert!(is_sentence, "{row} has no sentence: {sentence}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TestDirectory;

    const PAGE: &str =
        "before\n<!-- generated: begin -->\n| a |\n<!-- generated: end -->\nafter <!-- generated: end -->\n";

    #[test]
    fn part_is_compared_between_its_comments() {
        let directory = TestDirectory::new();
        let file = GeneratedFile::new(directory.write("page.md", PAGE), "make it");
        file.check(PAGE);
        file.check_part("| a |\n");
        assert_eq!(file.read(), PAGE);
    }

    #[test]
    #[should_panic(expected = "write it anew: make it")]
    fn other_text_is_a_failure() {
        let directory = TestDirectory::new();
        let file = GeneratedFile::new(directory.write("page.md", PAGE), "make it");
        // With an update requested it would be written, and be equal.
        file.check_by("| b |\n", |_| false);
    }

    #[test]
    #[should_panic(expected = "no sentence: without an end")]
    fn cell_without_a_sentence_is_a_failure() {
        check_cells("row", "It is one.", "without an end");
    }
}
