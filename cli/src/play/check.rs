//! `sinew play --check`: runs a program in virtual time on a recording, and compares its messages with the recorded
//! ones.
//!
//! The program is started with the path of a folder in an environment variable. The folder names this command, so that
//! a variable that was left behind has no effect. The program's first node with an application of the recording runs
//! these applications there, and writes a report instead of starting.

use std::{
    collections::BTreeMap,
    fs,
    io::{self, Read as _},
    os::{
        fd::AsFd as _,
        unix::{fs::DirBuilderExt as _, process::CommandExt as _},
    },
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process_group};
use serde_json::json;
use sinew::{
    Tid, Time,
    replay::exchange::{self, CheckOwner, CheckReport, ReportedDifference},
};
use sinew_player::{Recording, RecordingError};

use super::Order;
use crate::{
    Report,
    record::stop::StopRequest,
    system::SystemError,
    table::{clean, clean_lines},
};

/// Time between two looks at the program.
const LOOK: Duration = Duration::from_millis(5);
/// Maximum bytes of the lines about applications that the recording does not have.
const DECLARED_BYTES_MAX: u64 = 64 << 10;

impl From<RecordingError> for SystemError {
    fn from(error: RecordingError) -> Self {
        Self::Bag(error.to_string())
    }
}

/// Checks the program.
pub(crate) fn show(order: &Order, stop: &StopRequest) -> Result<Report, SystemError> {
    let mut recording = Recording::read_until(&order.files, order.to)?.starts_before(order.start_before);
    for field in &order.ignored {
        recording = recording.ignoring(field.as_str());
    }
    if let Some(name) = &order.turns {
        recording = recording.turns(name);
    }
    let damage = recording.damage().to_vec();
    let request = recording.into_order(&order.apps)?;
    let names: BTreeMap<u64, String> = request.names.iter().map(|(name, tid)| (*tid, name.clone())).collect();
    let folder = Folder::new()?;
    exchange::write(&folder.0.join(exchange::ORDER), &request).map_err(|why| unwritable(&folder.0, &why))?;
    // It may have a gigabyte.
    drop(request);
    let until = name_owner(order, &folder)?;
    let status = run(order, &folder, until, stop)?;
    let report = exchange::read::<CheckReport>(&folder.0.join(exchange::REPORT), exchange::REPORT_BYTES_MAX);
    let Ok(report) = report else { return Err(SystemError::Bag(unreported(order, &folder, status))) };
    match report {
        CheckReport::Identical { messages, sources, misfits } => {
            Ok(identical(messages, sources, &misfits, &damage))
        }
        CheckReport::Differs(difference) => Ok(differs(&difference, &names, &damage)),
        CheckReport::Failed(why) => {
            Err(SystemError::Bag(format!("the check did not reach its end: {}", clean(&why))))
        }
    }
}

/// Names this command in the folder: only its children run the check, and only until the time that is returned.
fn name_owner(order: &Order, folder: &Folder) -> Result<Time, SystemError> {
    let from = Time::now();
    let until = from + order.within;
    let owner =
        CheckOwner { process: std::process::id(), from_ns: from.as_nanos(), until_ns: until.as_nanos() };
    let written = exchange::write(&folder.0.join(exchange::OWNER), &owner);
    written.map_err(|why| unwritable(&folder.0, &why))?;
    Ok(until)
}

/// Runs the program to its end. Its standard output is this command's standard error.
fn run(order: &Order, folder: &Folder, until: Time, stop: &StopRequest) -> Result<ExitStatus, SystemError> {
    let Some((program, arguments)) = order.program.split_first() else {
        return Err(SystemError::Usage("no program to check; write it behind `--`".to_owned()));
    };
    let shown = clean(&program.to_string_lossy());
    let refused =
        |why: io::Error| SystemError::Bag(format!("{shown} cannot be run: {why}; check its path and rights"));
    let output = io::stderr().as_fd().try_clone_to_owned().map_err(refused)?;
    let mut command = Command::new(program);
    command.args(arguments).env(exchange::VARIABLE, &folder.0).stdin(Stdio::null()).stdout(output);
    // The program may be the child of a script or of `cargo run`: its group is ended with it.
    command.process_group(0);
    let mut child = Running(command.spawn().map_err(refused)?);
    loop {
        if let Some(status) = child.0.try_wait().map_err(refused)? {
            return Ok(status);
        }
        if stop.is_there() {
            return Err(SystemError::Bag("the check was stopped before its end".to_owned()));
        }
        if Time::now() >= until {
            let within = order.within;
            return Err(SystemError::Bag(format!(
                "{shown} has not ended within {within:?}; give it more time: --within. {}",
                declared(&folder.0)
            )));
        }
        std::thread::sleep(LOOK);
    }
}

/// A program that is ended with the command, and with it all processes of its group.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        if matches!(self.0.try_wait(), Ok(None)) {
            // It was not waited for, so the number is still that of its group. This fails only if the group has ended.
            let _ = kill_process_group(Pid::from_child(&self.0), Signal::KILL);
        }
        // This fails only if it was waited for.
        let _ = self.0.wait();
    }
}

/// The folder of order and report, which is removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Result<Self, SystemError> {
        let (process, now) = (std::process::id(), Time::now().as_nanos());
        let path = std::env::temp_dir().join(format!("sinew-check-{process}-{now}"));
        match fs::DirBuilder::new().mode(0o700).create(&path) {
            Ok(()) => Ok(Self(path)),
            Err(why) => Err(unwritable(&path, &why)),
        }
    }
}

fn unwritable(folder: &Path, why: &io::Error) -> SystemError {
    let folder = folder.display();
    SystemError::Bag(format!("{folder} cannot be written: {why}; set TMPDIR to a folder with room"))
}

impl Drop for Folder {
    fn drop(&mut self) {
        // The system clears the folder of temporary files, too.
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Returns why there is no report.
fn unreported(order: &Order, folder: &Folder, status: ExitStatus) -> String {
    let program = order.program.first().map(|program| clean(&program.to_string_lossy())).unwrap_or_default();
    format!(
        "{program} has ended without a report ({status}). It must start its node with `Node::builder` or \
         `Node::from_file`, on a version of Sinew with this check. {}",
        declared(&folder.0)
    )
}

/// Returns the nodes of the program that have no application of the recording, in words.
fn declared(folder: &Path) -> String {
    let mut text = Vec::new();
    if let Ok(file) = fs::File::open(folder.join(exchange::DECLARED)) {
        // Without it, or with a part of it, the message says less.
        let _ = file.take(DECLARED_BYTES_MAX).read_to_end(&mut text);
    }
    let text = String::from_utf8_lossy(&text).into_owned();
    if text.is_empty() {
        return "No node of it has asked for the recording".to_owned();
    }
    let lines = clean_lines(&text).replace('\n', "; ");
    format!("No application of it is in the recording under this name, or was chosen by --app: {lines}")
}

fn identical(messages: u64, sources: u64, misfits: &[String], damage: &[String]) -> Report {
    let (word, result, end) = if damage.is_empty() {
        ("identical", "identical", "")
    } else {
        ("not whole", "not_whole", "are identical; those that the recording lacks are not compared")
    };
    let line = format!("{word}: {messages} messages of {sources} sources {end}");
    let mut text = format!("{}\n", line.trim_end());
    for line in misfits.iter().chain(damage) {
        text += &format!("{}\n", clean(line));
    }
    let json = json!({
        "result": result, "messages": messages, "sources": sources, "misfits": misfits, "damage": damage,
    });
    Report { text, json, is_fine: damage.is_empty() }
}

fn differs(difference: &ReportedDifference, names: &BTreeMap<u64, String>, damage: &[String]) -> Report {
    let ReportedDifference { source, number, at_ns, type_name, destination, difference, misfit } = difference;
    let shown = |tid: u64| names.get(&tid).cloned().unwrap_or_else(|| Tid::from_bits(tid).to_string());
    let (source, destination) = (shown(*source), shown(*destination));
    // As in the other lines of the report.
    let at = Time::from_nanos(*at_ns);
    let line = format!(
        "the first difference: message {number} of {source}, {type_name} to {destination} at {at:?}: \
         {difference}"
    );
    let mut text = format!("{}\n", clean(&line));
    for line in misfit.iter().chain(damage) {
        text += &format!("{}\n", clean(line));
    }
    let json = json!({
        "result": "differs", "source": source, "number": number, "at_ns": at_ns, "type": type_name,
        "destination": destination, "difference": difference, "misfit": misfit,
        "damage": damage,
    });
    Report { text, json, is_fine: false }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn difference_is_named_by_source_number_time_and_field() {
        let difference = ReportedDifference {
            source: 5,
            number: 7,
            at_ns: 1_500_000_000,
            type_name: "demo.torque".to_owned(),
            destination: Tid::from_bits(0x0a00_0002_0000_1001).bits(),
            difference: "`newton_metres` was 5.0 and is 2.5".to_owned(),
            misfit: Some("2 recorded messages, the first at 1.500000000s".to_owned()),
        };
        let report = differs(&difference, &BTreeMap::from([(5, "knee".to_owned())]), &[]);
        let expected = "the first difference: message 7 of knee, demo.torque to 10.0.0.2/1001 at 1.500000000s: \
                        `newton_metres` was 5.0 and is 2.5\n2 recorded messages, the first at 1.500000000s\n";
        assert_eq!((report.text.as_str(), report.is_fine), (expected, false));
        assert_eq!(report.json["source"], "knee");
    }

    #[test]
    fn check_of_a_damaged_recording_is_no_proof() {
        let whole = identical(7, 2, &[], &[]);
        assert_eq!((whole.text.as_str(), whole.is_fine), ("identical: 7 messages of 2 sources\n", true));
        let damage = ["walk.mcap: unfinished: the file ends at byte 9".to_owned()];
        let cut = identical(7, 2, &[], &damage);
        assert!(!cut.is_fine && cut.text.starts_with("not whole: 7 messages"), "{}", cut.text);
        assert!(cut.text.contains(&damage[0]), "{}", cut.text);
        assert_eq!((&cut.json["result"], &cut.json["damage"][0]), (&json!("not_whole"), &json!(damage[0])));
    }

    #[test]
    fn folder_is_removed_at_the_end() {
        let folder = Folder::new().expect("there is room");
        let path = folder.0.clone();
        fs::write(path.join(exchange::DECLARED), "node knee: drive\nnode hip: gait\n")
            .expect("there is room");
        assert!(declared(&path).contains("node knee: drive; node hip: gait"), "{}", declared(&path));
        drop(folder);
        assert!(!path.exists());
    }
}
