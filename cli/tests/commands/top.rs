//! `sinew top` as plain text, and on a terminal.

use std::{
    fs,
    path::Path,
    process::{Command, Output},
};

use sinew_testkit::{unique, until};

use crate::{
    logs::PLAIN,
    scenario::{Scenario, named},
};

/// Columns and lines of the terminal.
const SIZE: [&str; 4] = ["-x", "130", "-y", "48"];

/// A terminal of tmux in which the command runs. Its exit code is printed below it.
struct Terminal {
    server: String,
    directory: String,
}

impl Terminal {
    /// Starts the command in it; `None` where there is no tmux.
    fn start(scenario: &Scenario, name: &str, words: &[&str]) -> Option<Self> {
        if let Err(why) = Command::new("tmux").arg("-V").output() {
            eprintln!("skipped: tmux does not start ({why}); install it to test the screen");
            return None;
        }
        let directory = scenario.directory.join("").display().to_string();
        let terminal = Self { server: format!("sinew-{}", unique()), directory };
        let socket = scenario.socket(name).display().to_string();
        // The shell survives Ctrl-C, and the screen stays until the end of the test.
        let script = "trap : INT; \"$@\"; echo \"exit code $?\"; exec cat";
        let command = [env!("CARGO_BIN_EXE_sinew"), "--socket", &socket, "--deadline-ms", "10000"];
        let shell = ["sh", "-c", script, "sh"];
        let all = [&["new-session", "-d"][..], &SIZE, &["--"], &shell, &command, words].concat();
        let started = terminal.tmux(&all);
        assert!(started.status.success(), "{}", String::from_utf8_lossy(&started.stderr));
        Some(terminal)
    }

    fn tmux(&self, words: &[&str]) -> Output {
        let mut command = Command::new("tmux");
        command.args(["-L", &self.server, "-f", "/dev/null"]).args(words);
        command.env("TMUX_TMPDIR", &self.directory).env_remove("TMUX").env("LC_ALL", "C.UTF-8");
        command.output().expect("tmux starts")
    }

    fn press(&self, key: &str) {
        let pressed = self.tmux(&["send-keys", key]);
        assert!(pressed.status.success(), "{key}: {}", String::from_utf8_lossy(&pressed.stderr));
    }

    /// Waits until the screen satisfies the condition.
    fn until(&self, what: &str, is_so: impl Fn(&str) -> bool) {
        until(what, || {
            let screen = String::from_utf8_lossy(&self.tmux(&["capture-pane", "-p"]).stdout).into_owned();
            is_so(&screen).then_some(())
        });
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // It ends this server alone, and the command in it.
        let _ = self.tmux(&["kill-server"]);
    }
}

fn has_line(screen: &str, words: &[&str]) -> bool {
    screen.lines().any(|line| words.iter().all(|word| line.contains(word)))
}

#[test]
fn table_is_printed_once_without_a_terminal() {
    // Given: the hip sends counts to the knee
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_hip_that_sends_to_a_knee();
    // Then: its rates are within a second
    let json = scenario.until("the links are up and the counts arrive", "hip", &["top"], |json| {
        let has_rate = |row: &serde_json::Value, key: &str| row[key].as_f64() > Some(0.0);
        let links = json["links"].as_array().map_or(&[][..], Vec::as_slice);
        let is_out =
            |row: &&serde_json::Value| row["from"] == "hip" && row["to"] == "knee" && row["class"] == "bulk";
        named(&json["nodes"], "hip").is_some_and(|node| node["stop"] == "released")
            && named(&json["apps"], "knee").is_some_and(|app| has_rate(app, "in_per_s"))
            && links.iter().find(is_out).is_some_and(|row| row["state"] == "up" && has_rate(row, "out_per_s"))
    });
    let knee = named(&json["apps"], "knee").expect("it is there");
    assert_eq!(
        (&knee["node"], &knee["state"], &knee["restarts"]),
        (&"knee".into(), &"ready".into(), &0.into())
    );
    assert_eq!(json["losses"].as_array().map(Vec::len), Some(4), "{json}");
    let text = scenario.sinew("knee", &["top"]).out;
    for words in
        [&["Nodes"][..], &["hip", "127.0.0.1"], &["Applications"], &["Links"], &["hip", "knee", "bulk"]]
    {
        assert!(has_line(&text, words), "{words:?}: {text}");
    }
    assert!(!text.contains('\u{1b}'), "{text}");
}

#[test]
fn screen_shows_rates_and_handles_keys() {
    let scenario = Scenario::new();
    let (_hip, _knee) = scenario.start_a_hip_that_sends_to_a_knee();
    let Some(terminal) = Terminal::start(&scenario, "hip", &["top"]) else { return };
    let is_rate = |word: &str| word.parse::<f64>().is_ok_and(|rate| rate > 0.0);
    terminal.until("the counts arrive at the knee", |screen| {
        has_line(screen, &["knee", "127.0.0.2"])
            && screen.lines().any(|line| {
                line.starts_with("knee")
                    && line.contains("ready")
                    && line.split_whitespace().nth(3).is_some_and(is_rate)
            })
    });
    // When: only rows with a text are wanted
    for key in ["/", "1", "2", "7", ".", "0", ".", "0", ".", "2", "Enter"] {
        terminal.press(key);
    }
    terminal.until("the hip is left out", |screen| {
        has_line(screen, &["127.0.0.2", "up"]) && !has_line(screen, &["127.0.0.1 "])
    });
    terminal.press("Escape");
    terminal.until("the hip is shown again", |screen| has_line(screen, &["127.0.0.1 "]));
    terminal.press("p");
    terminal.until("it is paused", |screen| has_line(screen, &["sinew top", "PAUSED"]));
    terminal.press("p");
    terminal
        .until("it runs again", |screen| has_line(screen, &["sinew top"]) && !has_line(screen, &["PAUSED"]));
    // A small terminal has the first lines, and the arrows show the others.
    let is_title = |screen: &str| screen.lines().any(|line| line.trim_end() == "Nodes");
    terminal.tmux(&["resize-window", "-x", "130", "-y", "8"]);
    terminal
        .until("the screen is small", |screen| is_title(screen) && !screen.contains("Losses of messages"));
    terminal.press("Down");
    terminal.until("the first line is scrolled away", |screen| !is_title(screen));
    // A narrow one has the first columns, and the arrows show the others.
    terminal.tmux(&["resize-window", "-x", "40", "-y", "8"]);
    terminal.until("the last column is cut off", |screen| {
        has_line(screen, &["NODE", "STATE"]) && !screen.contains("LONGEST")
    });
    // A key before the new size does not count.
    terminal.until("the last column is shown", |screen| {
        let is_shown = screen.contains("LONGEST");
        if !is_shown {
            terminal.press("Right");
        }
        is_shown
    });
    // And: q gives the terminal back
    terminal.press("q");
    terminal.until("it has ended in order", |screen| has_line(screen, &["exit code 0"]));
}

#[test]
fn followed_log_shows_new_lines_until_interrupt() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, PLAIN);
    let Some(terminal) = Terminal::start(&scenario, "knee", &["logs", "-f"]) else { return };
    terminal.until("the start of the knee is shown", |screen| {
        has_line(screen, &["INFO knee", "the node has started"])
    });
    // When: another node starts
    let _hip = scenario.start("hip", 1, PLAIN);
    terminal.until("the start of the hip is shown", |screen| {
        has_line(screen, &["INFO hip", "the node has started"])
    });
    // And: Ctrl-C gives the terminal back
    terminal.press("C-c");
    terminal.until("it has ended in order", |screen| has_line(screen, &["exit code 0"]));
}

#[test]
fn terminal_that_closes_ends_the_screen() {
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let Some(terminal) = Terminal::start(&scenario, "knee", &["top"]) else { return };
    terminal.until("the screen is shown", |screen| has_line(screen, &["knee", "127.0.0.2"]));
    let shell = terminal.tmux(&["display-message", "-p", "#{pane_pid}"]).stdout;
    let shell = String::from_utf8(shell).expect("a number").trim().to_owned();
    let children =
        fs::read_to_string(format!("/proc/{shell}/task/{shell}/children")).expect("the shell runs");
    let command = children.split_whitespace().next().expect("the shell has started the command").to_owned();
    drop(terminal);
    until("the command has ended", || (!Path::new("/proc").join(&command).exists()).then_some(()));
}
