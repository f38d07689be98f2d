//! Code blocks of the documentation, for the tests that run them.

use std::process::{Command, Stdio};

/// The block of a page that starts with `fence` after `heading`.
#[must_use]
pub fn block(page: &'static str, heading: &str, fence: &str) -> &'static str {
    let section = page.split_once(heading).expect("the section is there").1;
    let block = section.split_once(fence).expect("the block begins").1;
    block.split_once("```").expect("the block ends").0
}

/// A Python program of a page. `None`, with a message, on a machine without Python 3.
#[must_use]
pub fn python(page: &'static str, heading: &str) -> Option<Command> {
    python_with(block(page, heading, "```python"))
}

/// This Python program, or `None` likewise.
#[must_use]
pub fn python_with(program: &str) -> Option<Command> {
    let is_there = Command::new("python3").arg("--version").stdout(Stdio::null()).status();
    if !is_there.is_ok_and(|status| status.success()) {
        println!("skipped: there is no python3 on this machine");
        return None;
    }
    let mut command = Command::new("python3");
    command.args(["-c", program]);
    Some(command)
}
