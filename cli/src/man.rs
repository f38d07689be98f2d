//! `sinew man`: a manual page of the program and of each of its commands, from the same declaration as the help.

use std::path::Path;

use clap_mangen::{
    Man,
    roff::{Roff, roman},
};
use serde_json::json;

use crate::{Report, arguments, system::SystemError};

/// Writes the pages into the folder. Existing ones are replaced.
pub(crate) fn write(folder: &Path) -> Result<Report, SystemError> {
    let mut program = arguments::command().disable_help_subcommand(true);
    program.build();
    let source = format!("sinew {}", program.get_version().unwrap_or_default());
    let mut names = Vec::new();
    for command in commands(program) {
        let page = described(command);
        let name = format!("{}.1", page.get_display_name().unwrap_or_else(|| page.get_name()));
        let path = folder.join(&name);
        std::fs::write(&path, rendered(&page, &source)).map_err(|error| {
            SystemError::Man(format!(
                "the manual page {} cannot be written: {error}; name an existing folder that you may write to",
                path.display()
            ))
        })?;
        names.push(name);
    }
    let text = format!("{} manual pages are in {}\n", names.len(), folder.display());
    Ok(Report {
        json: json!({ "folder": folder.display().to_string(), "pages": names }),
        text,
        is_fine: true,
    })
}

/// Returns the program and all commands below it, without hidden ones.
fn commands(program: clap::Command) -> Vec<clap::Command> {
    let (mut open, mut found) = (vec![program], Vec::new());
    while let Some(command) = open.pop() {
        open.extend(command.get_subcommands().filter(|below| !below.is_hide_set()).cloned());
        found.push(command);
    }
    found
}

/// Returns the command with its first sentence as its line in lists of pages.
fn described(command: clap::Command) -> clap::Command {
    let Some(text) = command.get_long_about().or_else(|| command.get_about()).map(ToString::to_string) else {
        return command;
    };
    let paragraph = text.lines().next().unwrap_or_default();
    let sentence = paragraph.split(". ").next().unwrap_or_default().trim_end_matches('.').to_owned();
    command.about(sentence).long_about(text)
}

/// Returns the page. Its sections of exit codes and examples are lines as they are in the help.
fn rendered(command: &clap::Command, source: &str) -> Vec<u8> {
    // An empty date has to be written as one: else the source takes its place.
    let man = Man::new(command.clone()).date("\"\"").source(source).manual("Sinew");
    let mut page = Vec::new();
    let mut written = man
        .render_title(&mut page)
        .and_then(|()| man.render_name_section(&mut page))
        .and_then(|()| man.render_synopsis_section(&mut page))
        .and_then(|()| man.render_description_section(&mut page))
        .and_then(|()| man.render_options_section(&mut page));
    if command.get_subcommands().any(|below| !below.is_hide_set()) {
        written = written.and_then(|()| man.render_subcommands_section(&mut page));
    }
    let last = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    written = written.and_then(|()| sections(&last).to_writer(&mut page));
    written.expect("a vector takes all bytes");
    page
}

/// Returns the text behind the options: a line that ends with a colon at the margin is a heading.
fn sections(text: &str) -> Roff {
    let mut roff = Roff::new();
    for line in text.lines() {
        match line.strip_suffix(':').filter(|heading| !heading.starts_with(' ')) {
            Some(heading) => {
                roff.control("fi", []).control("SH", [heading.to_uppercase().as_str()]).control("nf", []);
            }
            None => {
                roff.text([roman(line.strip_prefix("  ").unwrap_or(line))]);
            }
        }
    }
    roff.control("fi", []);
    roff
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_sentence_names_the_page() {
        let long = clap::Command::new("up").long_about("Starts a robot. It asks no node.\n\nMore.");
        let page = described(long);
        assert_eq!(page.get_about().map(ToString::to_string).as_deref(), Some("Starts a robot"));
        let text = String::from_utf8(rendered(&page, "sinew 1")).expect("it is text");
        assert!(text.contains("up \\- Starts a robot\n") && text.contains("It asks no node."), "{text}");
    }

    #[test]
    fn headings_of_the_help_are_sections() {
        let text = sections("Exit codes:\n  0  fine\n\nExamples:\n  sinew nodes").to_roff();
        assert!(text.contains(".SH \"EXIT CODES\"\n.nf\n0  fine\n"), "{text}");
        assert!(text.contains(".SH EXAMPLES\n.nf\nsinew nodes\n.fi"), "{text}");
    }
}
