//! What somebody asks of a bench on its command line.

use std::process::exit;

/// Words, which name cases, and options.
#[derive(Debug)]
pub struct Asked {
    words: Vec<String>,
    options: Vec<String>,
}

impl Asked {
    /// Reads the command line of the bench whose main file is `source`; an option that ends with `=` has a value. `--help` prints what that
    /// file says of itself and ends the process, with exit code 0; an option that is not among these ends it with 2.
    #[must_use]
    pub fn read(source: &str, options: &[&str]) -> Self {
        Self::parse(std::env::args().skip(1), source, options).unwrap_or_else(|told| {
            eprintln!("{}", told.text);
            exit(told.code);
        })
    }

    fn parse(arguments: impl Iterator<Item = String>, source: &str, options: &[&str]) -> Result<Self, Told> {
        let (given, words): (Vec<_>, Vec<_>) = arguments.partition(|argument| argument.starts_with('-'));
        if given.iter().any(|option| option == "--help" || option == "-h") {
            return Err(Told { text: about(source), code: 0 });
        }
        let is_known = |option: &str| {
            options.iter().any(|known| option == *known || known.ends_with('=') && option.starts_with(known))
        };
        // Cargo says itself that it runs a bench.
        let given: Vec<_> = given.into_iter().filter(|option| option != "--bench").collect();
        match given.iter().find(|option| !is_known(option)) {
            Some(unknown) => {
                let known = options.iter().chain(&["--help"]).copied().collect::<Vec<_>>().join(", ");
                Err(Told { text: format!("no such option: {unknown}; there are {known}"), code: 2 })
            }
            None => Ok(Self { words, options: given }),
        }
    }

    /// Whether that option was given.
    #[must_use]
    pub fn has(&self, option: &str) -> bool {
        self.options.iter().any(|given| given == option)
    }

    /// Whether a tenth is enough.
    #[must_use]
    pub fn is_short(&self) -> bool {
        self.has("--short")
    }

    /// What was given for an option that ends with `=`.
    #[must_use]
    pub fn value(&self, option: &str) -> Option<&str> {
        self.options.iter().find_map(|given| given.strip_prefix(option))
    }

    /// Whether a word asks for it, wherever in the word.
    #[must_use]
    pub fn names(&self, what: &str) -> bool {
        self.words.iter().any(|word| word.contains(what))
    }

    /// Those whose name holds every word. If there is none, says which there are and ends the process with exit code 2.
    #[must_use]
    pub fn wanted<T>(&self, all: impl IntoIterator<Item = T>, name: impl Fn(&T) -> String) -> Vec<T> {
        self.chosen(all, name).unwrap_or_else(|told| {
            eprintln!("{}", told.text);
            exit(told.code);
        })
    }

    fn chosen<T>(
        &self,
        all: impl IntoIterator<Item = T>,
        name: impl Fn(&T) -> String,
    ) -> Result<Vec<T>, Told> {
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
            return Err(Told { text, code: 2 });
        }
        Ok(wanted)
    }
}

/// What is said in the place of a run, and the exit code.
#[derive(Debug, PartialEq, Eq)]
struct Told {
    text: String,
    code: i32,
}

/// What a file says of itself at its beginning.
fn about(source: &str) -> String {
    let lines = source.lines().map_while(|line| line.strip_prefix("//!"));
    lines.map(|line| line.strip_prefix(' ').unwrap_or(line)).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOURCE: &str = "//! What it is.\n//!\n//! `--short` does a tenth.\nfn main() {}\n//! not this\n";

    fn parse(arguments: &[&str]) -> Result<Asked, Told> {
        Asked::parse(arguments.iter().map(ToString::to_string), SOURCE, &["--short", "--seed="])
    }

    #[test]
    fn options_are_read_and_unknown_ones_told() {
        let asked = parse(&["--bench", "kill", "--seed=7", "50ms"]).unwrap();
        assert!(!asked.is_short());
        assert_eq!(asked.value("--seed="), Some("7"));
        assert!(parse(&["--short"]).unwrap().is_short());
        let told = parse(&["--shirt"]).unwrap_err();
        assert_eq!(
            told,
            Told { text: "no such option: --shirt; there are --short, --seed=, --help".to_owned(), code: 2 }
        );
    }

    #[test]
    fn help_is_what_the_file_says_of_itself() {
        let told = parse(&["kill", "--help"]).unwrap_err();
        assert_eq!(told, Told { text: "What it is.\n\n`--short` does a tenth.".to_owned(), code: 0 });
    }

    #[test]
    fn a_case_is_wanted_whose_name_holds_every_word() {
        let names = ["kill-50ms", "kill-500ms", "stop-50ms"];
        let chosen = |words: &[&str]| parse(words).unwrap().chosen(names, ToString::to_string);
        assert_eq!(chosen(&["stop", "500ms"]).map_err(|told| told.code), Err(2));
        assert_eq!(chosen(&["kill", "l-50ms"]).unwrap(), ["kill-50ms"]);
        assert_eq!(chosen(&[]).unwrap(), names);
        let told = chosen(&["kilt"]).unwrap_err();
        assert_eq!(told.text, "no case has kilt in its name; there are kill-50ms, kill-500ms, stop-50ms");
    }
}
