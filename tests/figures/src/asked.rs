//! Command-line arguments of a bench.

use std::process::exit;

/// Case filters (words) and options.
#[derive(Debug)]
pub struct Asked {
    words: Vec<String>,
    options: Vec<String>,
}

impl Asked {
    /// Reads the command line of a bench. `source` is the text of its main file. An option that ends with `=`
    /// takes a value.
    ///
    /// `--help` prints the module documentation of `source` and exits with code 0. An unknown option exits
    /// with code 2.
    #[must_use]
    pub fn read(source: &str, options: &[&str]) -> Self {
        Self::parse(std::env::args().skip(1), source, options).unwrap_or_else(|early| {
            eprintln!("{}", early.text);
            exit(early.code);
        })
    }

    fn parse(
        arguments: impl Iterator<Item = String>,
        source: &str,
        options: &[&str],
    ) -> Result<Self, EarlyExit> {
        let (given, words): (Vec<_>, Vec<_>) = arguments.partition(|argument| argument.starts_with('-'));
        if given.iter().any(|option| option == "--help" || option == "-h") {
            return Err(EarlyExit { text: about(source), code: 0 });
        }
        let is_known = |option: &str| {
            options.iter().any(|known| option == *known || known.ends_with('=') && option.starts_with(known))
        };
        // Cargo passes `--bench` itself.
        let given: Vec<_> = given.into_iter().filter(|option| option != "--bench").collect();
        match given.iter().find(|option| !is_known(option)) {
            Some(unknown) => {
                let known = options.iter().chain(&["--help"]).copied().collect::<Vec<_>>().join(", ");
                Err(EarlyExit { text: format!("no such option: {unknown}; there are {known}"), code: 2 })
            }
            None => Ok(Self { words, options: given }),
        }
    }

    /// Returns whether this option was given.
    #[must_use]
    pub fn has(&self, option: &str) -> bool {
        self.options.iter().any(|given| given == option)
    }

    /// Returns whether a tenth of the full run is enough (`--short`).
    #[must_use]
    pub fn is_short(&self) -> bool {
        self.has("--short")
    }

    /// The value of an option that ends with `=`.
    #[must_use]
    pub fn value(&self, option: &str) -> Option<&str> {
        self.options.iter().find_map(|given| given.strip_prefix(option))
    }

    /// Returns whether any filter word occurs in this name.
    #[must_use]
    pub fn names(&self, what: &str) -> bool {
        self.words.iter().any(|word| word.contains(what))
    }

    /// The items with a name that contains every filter word. If none matches, lists all names and exits with
    /// code 2.
    #[must_use]
    pub fn wanted<T>(&self, all: impl IntoIterator<Item = T>, name: impl Fn(&T) -> String) -> Vec<T> {
        self.chosen(all, name).unwrap_or_else(|early| {
            eprintln!("{}", early.text);
            exit(early.code);
        })
    }

    fn chosen<T>(
        &self,
        all: impl IntoIterator<Item = T>,
        name: impl Fn(&T) -> String,
    ) -> Result<Vec<T>, EarlyExit> {
        let (mut wanted, mut others) = (Vec::new(), Vec::new());
        for case in all {
            let name = name(&case);
            if self.words.iter().all(|word| name.contains(word.as_str())) {
                wanted.push(case)
            } else {
                others.push(name)
            }
        }
        if wanted.is_empty() {
            let text = format!(
                "no case has {} in its name; there are {}",
                self.words.join(" and "),
                others.join(", ")
            );
            return Err(EarlyExit { text, code: 2 });
        }
        Ok(wanted)
    }
}

/// Text that is printed instead of running, and the exit code.
#[derive(Debug, PartialEq, Eq)]
struct EarlyExit {
    text: String,
    code: i32,
}

/// The module documentation at the top of a source file.
fn about(source: &str) -> String {
    let lines = source.lines().map_while(|line| line.strip_prefix("//!"));
    lines.map(|line| line.strip_prefix(' ').unwrap_or(line)).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOURCE: &str = "//! What it is.\n//!\n//! `--short` does a tenth.\nfn main() {}\n//! not this\n";

    fn parse(arguments: &[&str]) -> Result<Asked, EarlyExit> {
        Asked::parse(arguments.iter().map(ToString::to_string), SOURCE, &["--short", "--seed="])
    }

    #[test]
    fn options_are_read_and_unknown_ones_rejected() {
        let asked = parse(&["--bench", "kill", "--seed=7", "50ms"]).unwrap();
        assert!(!asked.is_short());
        assert_eq!(asked.value("--seed="), Some("7"));
        assert!(parse(&["--short"]).unwrap().is_short());
        let early = parse(&["--shirt"]).unwrap_err();
        assert_eq!(
            early,
            EarlyExit {
                text: "no such option: --shirt; there are --short, --seed=, --help".to_owned(),
                code: 2
            }
        );
    }

    #[test]
    fn help_prints_the_module_documentation() {
        let early = parse(&["kill", "--help"]).unwrap_err();
        assert_eq!(early, EarlyExit { text: "What it is.\n\n`--short` does a tenth.".to_owned(), code: 0 });
    }

    #[test]
    fn case_is_selected_if_its_name_contains_every_word() {
        let names = ["kill-50ms", "kill-500ms", "stop-50ms"];
        let chosen = |words: &[&str]| parse(words).unwrap().chosen(names, ToString::to_string);
        assert_eq!(chosen(&["stop", "500ms"]).map_err(|early| early.code), Err(2));
        assert_eq!(chosen(&["kill", "l-50ms"]).unwrap(), ["kill-50ms"]);
        assert_eq!(chosen(&[]).unwrap(), names);
        let early = chosen(&["kilt"]).unwrap_err();
        assert_eq!(early.text, "no case has kilt in its name; there are kill-50ms, kill-500ms, stop-50ms");
    }
}
