//! `sinew play`: sends the messages of a recording again, or checks a program against them.

mod check;
mod pace;
mod report;
mod route;
mod session;
mod sources;
mod target;

use std::{ffi::OsString, path::PathBuf, time::Duration};

use clap::Args;
use sinew::inspect::Selection;
use sinew_player::{Playback, RecordedChannel};

use crate::{Report, arguments::Arguments, record::stop::StopRequest, system::SystemError, table::clean};
use pace::Rate;
use target::Target;

/// The project of the command's own node; others that begin with it are allowed, too.
const PROJECT: &str = "replay";

/// The arguments of `sinew play`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// The file: a part of a recording, or a merged file. Give all parts of a recording of one node
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// How fast: 1 is as recorded, 0.5 half as fast; `max` does not wait
    #[arg(long, value_name = "FACTOR", default_value = "1", value_parser = Rate::read)]
    rate: Rate,
    /// Begin again at the end, until Ctrl-C
    #[arg(long = "loop")]
    is_looped: bool,
    /// Leave out messages that were sent earlier than so long after the first one, as in 10s
    #[arg(long, value_name = "TIME", value_parser = span)]
    from: Option<Duration>,
    /// End so long after the first message, as in 20s
    #[arg(long, value_name = "TIME", value_parser = span)]
    to: Option<Duration>,
    /// Only messages of this application, by its name; `*` matches any text. May be given several times
    #[arg(long = "source", value_name = "NAME")]
    sources: Vec<String>,
    /// Only this type of payload, by its name; `*` matches any text. May be given several times
    #[arg(long = "type", value_name = "NAME")]
    types: Vec<String>,
    /// Send to a running node (--socket), and through it to the system. Without it the command has a node of its own on
    /// loopback
    #[arg(long)]
    live: bool,
    /// The project of its own node: `replay`, or a name that begins with `replay-`
    #[arg(long, value_name = "NAME", default_value = PROJECT, conflicts_with = "live", value_parser = project)]
    project: String,
    /// How long to wait for the destinations before the first message
    #[arg(long, value_name = "TIME", default_value = "2s", value_parser = span)]
    wait: Duration,
    /// Run PROGRAM in virtual time on the messages that it received, and compare all that it sends, bit by bit
    #[arg(
        long,
        requires = "program",
        conflicts_with_all = ["rate", "is_looped", "from", "sources", "types", "live", "project", "wait"]
    )]
    check: bool,
    /// Check this application of the program. May be given several times; without it all that the recording has
    #[arg(long = "app", value_name = "NAME", requires = "check")]
    apps: Vec<String>,
    /// Do not compare this field of payloads, such as one with a time: `t_ns`, `pose.t_ns`. May be given several times
    #[arg(long = "ignore", value_name = "FIELD", requires = "check")]
    ignored: Vec<String>,
    /// The applications record their turns by this type: they get these messages back, and only these are compared
    #[arg(long, value_name = "TYPE", requires = "check")]
    turns: Option<String>,
    /// The applications start so long before their first message, as in 10ms for one with a timer of 10 ms
    #[arg(long, value_name = "TIME", default_value = "0s", value_parser = span)]
    start_before: Duration,
    /// How long the program has for the check
    #[arg(long, value_name = "TIME", default_value = "60s", value_parser = span)]
    within: Duration,
    /// The program to check, and its arguments
    #[arg(last = true, value_name = "PROGRAM", requires = "check")]
    program: Vec<OsString>,
}

/// Plays the recording, or checks the program.
pub(crate) fn show(order: &Order, arguments: &Arguments) -> Result<Report, SystemError> {
    let stop = StopRequest::listen()
        .map_err(|why| SystemError::Bag(format!("Ctrl-C cannot be handled: {why}; free descriptors")))?;
    if order.check {
        return check::show(order, &stop);
    }
    if order.to.is_some_and(|to| to <= order.from.unwrap_or_default()) {
        return Err(SystemError::Usage(
            "--to is not later than --from; both are times from the first message".to_owned(),
        ));
    }
    // Opened first: a file that cannot be read needs no node.
    let playback = order.open()?;
    let mut target = Target::open(order, arguments)?;
    let played = session::play(order, playback, &mut target, &stop);
    let given_up = target.close();
    let is_lost = played.as_ref().map_or(true, |played| matches!(played.end, session::End::Lost(_)));
    if let Some(why) = given_up.filter(|_| is_lost) {
        return Err(why);
    }
    let played = played?;
    Ok(report::of(&played, arguments.wide))
}

impl Order {
    /// Opens the files, without the channels that are not chosen.
    fn open(&self) -> Result<Playback, SystemError> {
        let mut playback = Playback::open(&self.files, sinew_player::Order::Sent)?;
        playback.retain(|channel| self.chooses(channel));
        Ok(playback)
    }

    fn chooses(&self, channel: &RecordedChannel) -> bool {
        let (apps, types) = (self.sources.clone(), self.types.clone());
        let selection = Selection { apps, types, groups: Vec::new() };
        selection.has_app(channel.source_name.as_deref().unwrap_or_default())
            && selection.has_type(&channel.type_name)
    }
}

/// Reads a time, which may be zero: `10s`, `500ms`, `1h 30m`.
fn span(text: &str) -> Result<Duration, String> {
    humantime::parse_duration(text).map_err(|why| format!("{why}; write a time as in 10s or 500ms"))
}

/// Reads the project of the command's own node. It is never that of a robot.
fn project(text: &str) -> Result<String, String> {
    let is_own = text == PROJECT || text.strip_prefix(PROJECT).is_some_and(|rest| rest.starts_with('-'));
    if is_own {
        return Ok(text.to_owned());
    }
    let text = clean(text);
    Err(format!(
        "`{text}` may be the project of a robot; write `{PROJECT}` or a name that begins with `{PROJECT}-`, or use --live"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn project_of_a_robot_is_refused() {
        assert_eq!(project("replay").as_deref(), Ok("replay"));
        assert_eq!(project("replay-7").as_deref(), Ok("replay-7"));
        for robot in ["walker", "replays", ""] {
            assert!(project(robot).unwrap_err().contains("--live"), "{robot}");
        }
    }

    #[test]
    fn times_may_be_zero_and_faults_have_an_example() {
        assert_eq!((span("0s"), span("500ms")), (Ok(Duration::ZERO), Ok(Duration::from_millis(500))));
        assert!(span("soon").unwrap_err().contains("10s"));
    }
}
