//! Checks that the book's page on the command line shows the current help of each command.

use std::{
    collections::BTreeSet,
    fmt::Write as _,
    path::{Path, PathBuf},
    process::Command,
};

use sinew_testkit::{program, reference::GeneratedFile};

use crate::scenario::Answer;

const COMMAND: &str = "UPDATE=1 cargo test --workspace --test commands -- reference";
/// Columns of a block on the page.
const WIDTH: usize = 100;

/// A program with commands, as shown by its help.
struct Shown {
    path: PathBuf,
    name: &'static str,
    /// Options of the program itself, which all its commands share.
    common: BTreeSet<String>,
    page: String,
}

impl Shown {
    fn new(name: &'static str, path: PathBuf) -> Self {
        let mut shown = Self { path, name, common: BTreeSet::new(), page: String::new() };
        let help = shown.help(&[]);
        shown.common = options(&help).into_iter().collect();
        shown
    }

    fn help(&self, commands: &[&str]) -> String {
        let answer = Answer::of(Command::new(&self.path).args(commands).arg("--help"));
        assert_eq!(answer.code, Some(0), "{} {commands:?}: {}{}", self.name, answer.out, answer.err);
        answer.out
    }

    /// Adds the help of this command and of its subcommands.
    fn add(&mut self, commands: &[&str]) {
        let help = self.help(commands);
        let (level, block) = match commands {
            [] => ("##", help.clone()),
            [..] => ("###", without(&help, &self.common)),
        };
        let called = [&[self.name][..], commands].concat().join(" ");
        let block = wrapped(block.trim_end());
        let _ = write!(self.page, "\n{level} `{called}`\n\n```text\n{block}```\n");
        for below in subcommands(&help) {
            self.add(&[commands, &[below.as_str()][..]].concat());
        }
    }
}

/// Returns the lines of the section under `heading`.
fn section<'h>(help: &'h str, heading: &str) -> Vec<&'h str> {
    let lines = help.lines().skip_while(|line| *line != heading).skip(1);
    lines.take_while(|line| line.is_empty() || line.starts_with(' ')).collect()
}

/// Returns the subcommands except `help`, because this page shows the help.
fn subcommands(help: &str) -> Vec<String> {
    let names = section(help, "Commands:").into_iter().filter_map(|line| line.split_whitespace().next());
    names.filter(|name| *name != "help").map(str::to_owned).collect()
}

/// Returns the options, each with its text on one line, the same for the long and the short form of help.
fn options(help: &str) -> Vec<String> {
    let mut options: Vec<String> = Vec::new();
    for line in section(help, "Options:") {
        match options.last_mut() {
            Some(option) if !begins_option(line) => *option += &format!(" {line}"),
            Some(_) | None => options.push(line.to_owned()),
        }
    }
    let flat = |option: String| option.split_whitespace().collect::<Vec<_>>().join(" ");
    options.into_iter().map(|option| flat(option).replace(" (see a summary with '-h')", "")).collect()
}

fn begins_option(line: &str) -> bool {
    line.starts_with("  -") || line.starts_with("      --")
}

/// Returns the help without the options that all commands of the program share.
fn without(help: &str, common: &BTreeSet<String>) -> String {
    let lines = section(help, "Options:");
    let mut kept: Vec<&str> = Vec::new();
    let mut at = 0;
    for option in options(help) {
        let mut length = 1;
        while at + length < lines.len() && !begins_option(lines[at + length]) {
            length += 1;
        }
        if !common.contains(&option) {
            kept.extend(&lines[at..at + length]);
        }
        at += length;
    }
    let (before, rest) = help.split_once("Options:\n").unwrap_or((help, ""));
    let after = rest.lines().skip(lines.len()).map(|line| format!("{line}\n")).collect::<String>();
    let options =
        if kept.is_empty() { String::new() } else { format!("Options:\n{}\n\n", kept.join("\n").trim_end()) };
    format!("{before}{options}{after}")
}

fn indent(line: &str) -> usize {
    line.len() - line.trim_start().len()
}

/// Returns the column at which the text of a line begins: after a word with its description in a second column, else
/// after the indent.
fn hang(line: &str) -> usize {
    let words = line.trim_start();
    match words.find("  ").filter(|_| indent(line) > 0) {
        Some(gap) => line.len() - words[gap..].trim_start().len(),
        None => indent(line),
    }
}

/// Wraps a text to the width of the page. Continuation lines have the indent of the text of their line.
fn wrapped(text: &str) -> String {
    let mut lines: Vec<String> = Vec::new();
    for line in text.lines().map(str::trim_end) {
        let goes_on = |last: &&mut String| {
            let is_text = !line.is_empty() && !line.trim_start().starts_with('-');
            is_text && last.len() > WIDTH && hang(last) == indent(line)
        };
        match lines.last_mut().filter(goes_on) {
            Some(last) => *last += &format!(" {}", line.trim_start()),
            None => lines.push(line.to_owned()),
        }
    }
    lines.iter().map(|line| wrapped_line(line) + "\n").collect()
}

fn wrapped_line(line: &str) -> String {
    if line.len() <= WIDTH {
        return line.to_owned();
    }
    let hang = hang(line);
    let (mut all, mut last) = (String::new(), line[..hang].to_owned());
    for word in line[hang..].split_whitespace() {
        let gap = usize::from(last.len() > hang);
        if last.len() > hang && last.len() + gap + word.len() > WIDTH {
            all += &(last + "\n");
            last = " ".repeat(hang) + word;
        } else {
            last += &(" ".repeat(gap) + word);
        }
    }
    all + &last
}

#[test]
fn page_shows_the_help_of_each_command() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/book/src/reference/commands.md");
    let page = GeneratedFile::new(path, COMMAND);
    let mut expected = String::new();
    let own = PathBuf::from(env!("CARGO_BIN_EXE_sinew"));
    for (name, path) in
        [("sinew", own), ("sinew-node", program("sinew-node")), ("exoskeleton", program("exoskeleton"))]
    {
        let mut shown = Shown::new(name, path);
        shown.add(&[]);
        expected.push_str(&shown.page);
    }
    expected.push('\n');
    page.check_part(&expected);
}

#[test]
fn long_line_continues_below_its_text() {
    let words = "word ".repeat(25);
    let wrapped = wrapped(&format!("  doctor  {words}\n          more\n  keys    {words}\n"));
    let lines: Vec<_> = wrapped.lines().collect();
    assert!(lines.len() == 4 && lines.iter().all(|line| line.len() <= WIDTH), "{wrapped}");
    assert!(
        lines[0].starts_with("  doctor  word word") && lines[1].starts_with("          word"),
        "{wrapped}"
    );
    assert!(lines[1].ends_with("word more") && lines[2].starts_with("  keys    word"), "{wrapped}");
}
