//! The stored counts of instructions, `benches/instructions/figures.json`.

use std::collections::BTreeMap;

use crate::paths;

/// Counts of one compiler, C library and profile.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Instructions {
    /// Compiler, C library and profile.
    pub(crate) key: String,
    /// Instructions of a round trip by path, the least first.
    pub(crate) counts: Vec<(String, u64)>,
}

impl Instructions {
    /// Parses the file. Of several keys the last one of a release build is taken, if there is one.
    ///
    /// # Errors
    /// The text has another format, or no counts.
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let all: BTreeMap<String, BTreeMap<String, u64>> =
            serde_json::from_str(text).map_err(|why| why.to_string())?;
        let newest = all.into_iter().max_by_key(|(key, _)| (key.ends_with("release"), key.clone()));
        let (key, counts) = newest.ok_or("there are no counts")?;
        let named = |(name, count): (String, u64)| (paths::counted(&name).to_owned(), count);
        let mut counts: Vec<_> = counts.into_iter().map(named).collect();
        counts.sort_by_key(|(_, count)| *count);
        Ok(Self { key, counts })
    }

    /// The command and the conditions, a line each.
    pub(crate) fn caption(&self) -> Vec<String> {
        let profile = if self.key.ends_with("release") { " --release" } else { "" };
        vec![format!("cargo run{profile} -p sinew-instructions, under valgrind"), self.key.clone()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn release_is_preferred_and_counts_are_sorted() {
        let text = r#"{"rustc 1, debug": {"direct": 9}, "rustc 1, release": {"direct": 7, "same_thread": 2}, "rustc 2, debug": {}}"#;
        let read = Instructions::parse(text).unwrap();
        assert_eq!(read.key, "rustc 1, release");
        let named = [("one thread", 2), ("two processes, direct link", 7)];
        assert_eq!(read.counts, named.map(|(name, count)| (name.to_owned(), count)));
        assert!(read.caption()[0].contains("--release"));
    }

    #[test]
    fn file_without_counts_is_an_error() {
        assert!(Instructions::parse("{}").is_err());
        assert!(Instructions::parse(r#"{"key": {"direct": "many"}}"#).is_err());
    }
}
