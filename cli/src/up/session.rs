//! A session with a host: this program's command `host` on this host, or by the system's `ssh` on another one.
//!
//! Another host needs nothing but a shell: where its folder lacks this program, it is copied there first, once for each
//! version. A session is one connection for all requests.

mod streams;

use std::{
    fs::File,
    io,
    path::{Path, PathBuf},
    process::Command,
    time::Duration,
};

use super::{
    order::Hash,
    protocol::{Answer, NodeSeen, Request},
    robot::Host,
};
use crate::table::{clean_lines, quoted, short};
use streams::{Streams, Written};

/// Time limit for a connection and its first answer.
const ENTERED_WITHIN: Duration = Duration::from_secs(15);
/// Time limit for an answer, beyond the time that the request itself may take.
const ANSWERED_WITHIN: Duration = Duration::from_secs(20);
/// Bytes of a file for which a connection has one second more.
const BYTES_PER_SECOND: u64 = 128 << 10;
/// Time limit for a program to end, after its streams have ended.
const ENDED_WITHIN: Duration = Duration::from_secs(2);
/// Seconds for `ssh` to connect.
const CONNECT_S: u32 = 5;
/// Exit code of the shell there if its folder lacks this program.
const LACKS_PROGRAM: i32 = 77;
/// Exit code of `ssh` itself.
const SSH_FAILED: i32 = 255;

/// Whether a session changes something.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Access {
    Look,
    Change,
}

/// Why a host did not do a request.
#[derive(Clone, Debug, thiserror::Error)]
pub(super) enum HostError {
    /// There is no connection. Nothing is known of its nodes.
    #[error("host {host} is not reachable: {why}")]
    Unreachable {
        /// Its name in the robot file.
        host: String,
        /// The cause and the remedy.
        why: String,
    },
    /// It has answered with a refusal.
    #[error("host {host}: {why}")]
    Refused {
        /// Its name in the robot file.
        host: String,
        /// The cause and the remedy.
        why: String,
    },
}

/// A connection to a host.
#[derive(Debug)]
pub(super) struct Session {
    host: String,
    streams: Streams,
    /// The folder of the robot there.
    pub(super) folder: PathBuf,
}

impl Session {
    /// Connects to a host, copies this program there if needed, and enters the robot's folder.
    pub(super) fn open(name: &str, host: &Host, robot: &str, access: Access) -> Result<Self, HostError> {
        let unreachable = |why| HostError::Unreachable { host: name.to_owned(), why };
        let enter = Request::Enter {
            robot: robot.to_owned(),
            folder: host.folder.clone(),
            changes: access == Access::Change,
        };
        let (mut session, answer) = match &host.ssh {
            None => {
                let program = std::env::current_exe().map_err(|error| unreachable(error.to_string()))?;
                let mut command = Command::new(program);
                let mut session = Self::start(name, command.arg("host")).map_err(unreachable)?;
                let answer = session.ask_within(&enter, ENTERED_WITHIN)?;
                (session, answer)
            }
            Some(destination) => Self::by_ssh((name, host), destination, &enter)?,
        };
        let Answer::Entered { folder } = answer else { return Err(session.unfit(&answer)) };
        session.folder = PathBuf::from(folder);
        Ok(session)
    }

    fn start(name: &str, command: &mut Command) -> Result<Self, String> {
        let program = command.get_program().to_string_lossy().into_owned();
        let streams = Streams::start(command)
            .map_err(|error| format!("the program {program} cannot be run: {error}; is it installed?"))?;
        Ok(Self { host: name.to_owned(), streams, folder: PathBuf::new() })
    }

    /// Connects by `ssh`, at most twice: the second time after this program was copied.
    fn by_ssh(
        (name, host): (&str, &Host),
        destination: &str,
        enter: &Request,
    ) -> Result<(Self, Answer), HostError> {
        let unreachable = |why| HostError::Unreachable { host: name.to_owned(), why };
        let program = host.sinew.clone().map_or_else(std::env::current_exe, Ok);
        let program = program.map_err(|error| unreachable(error.to_string()))?;
        let (hash, bytes) = Hash::of_file(&program)
            .map_err(|error| unreachable(format!("{}: {error}", program.display())))?;
        let remote = RemoteProgram { folder: host.folder.as_deref(), hash: &hash };
        let mut is_copied = false;
        loop {
            let mut session =
                Self::start(name, ssh(host, destination).arg(remote.run())).map_err(unreachable)?;
            let why = match session.ask_within(enter, ENTERED_WITHIN) {
                Ok(answer) => return Ok((session, answer)),
                Err(HostError::Unreachable { why, .. }) => why,
                Err(refused @ HostError::Refused { .. }) => return Err(refused),
            };
            let code = session.streams.wait(ENDED_WITHIN);
            if code != Some(LACKS_PROGRAM) || is_copied {
                return Err(unreachable(explained(code, &why, destination)));
            }
            copy(host, destination, &remote, (&program, bytes)).map_err(unreachable)?;
            is_copied = true;
        }
    }

    /// Asks the host, and waits for its answer.
    pub(super) fn ask(&mut self, request: &Request) -> Result<Answer, HostError> {
        let more = match request {
            Request::Stop { within_ms, .. } => Duration::from_millis(*within_ms),
            Request::Enter { .. }
            | Request::Observe { .. }
            | Request::Missing(_)
            | Request::Put { .. }
            | Request::Check(_)
            | Request::Start(_)
            | Request::WriteUnit { .. }
            | Request::WriteTarget(_)
            | Request::Remove { .. }
            | Request::Sweep
            | Request::Log { .. } => Duration::ZERO,
        };
        self.ask_within(request, ANSWERED_WITHIN + more)
    }

    /// Sends a file. The host stores its content under the hash.
    pub(super) fn put(&mut self, hash: &Hash, path: &Path) -> Result<u64, HostError> {
        let failed = |error: io::Error| HostError::Refused {
            host: self.host.clone(),
            why: format!("{}: {error}", path.display()),
        };
        let file = File::open(path).map_err(failed)?;
        let bytes = file.metadata().map_err(failed)?.len();
        let request = Request::Put { hash: hash.clone(), bytes };
        self.write(&request)?;
        if self.streams.write(Written::File(file, bytes)).is_err() {
            return Err(self.lost("the connection has ended"));
        }
        let within = ANSWERED_WITHIN + Duration::from_secs(bytes / BYTES_PER_SECOND);
        self.answer(within).map(|_| bytes)
    }

    /// Returns the nodes with files on the host.
    pub(super) fn observe(&mut self, asks: bool) -> Result<Vec<NodeSeen>, HostError> {
        let answer = self.ask(&Request::Observe { asks })?;
        let Answer::Nodes(nodes) = answer else { return Err(self.unfit(&answer)) };
        Ok(nodes)
    }

    /// Asks for something to be done, and returns the host's note.
    pub(super) fn order(&mut self, request: &Request) -> Result<String, HostError> {
        let answer = self.ask(request)?;
        let (Answer::Done(note) | Answer::Log(note)) = answer else { return Err(self.unfit(&answer)) };
        Ok(note)
    }

    fn ask_within(&mut self, request: &Request, within: Duration) -> Result<Answer, HostError> {
        self.write(request)?;
        self.answer(within)
    }

    fn write(&mut self, request: &Request) -> Result<(), HostError> {
        let mut line = serde_json::to_vec(request).map_err(|error| self.lost(&error.to_string()))?;
        line.push(b'\n');
        match self.streams.write(Written::Line(line)) {
            Ok(()) => Ok(()),
            Err(_) => Err(self.lost("the connection has ended")),
        }
    }

    fn answer(&mut self, within: Duration) -> Result<Answer, HostError> {
        let line = self.streams.line(within).map_err(|why| self.lost(&why))?;
        match serde_json::from_slice(&line) {
            Ok(Answer::Refused(why)) => {
                Err(HostError::Refused { host: self.host.clone(), why: clean_lines(&why) })
            }
            Ok(answer) => Ok(answer),
            Err(_) => {
                let answer = short(String::from_utf8_lossy(&line).trim_end());
                Err(self.lost(&format!("it answered: {answer}")))
            }
        }
    }

    /// Returns the error of a lost connection, with the words of `ssh`.
    fn lost(&mut self, why: &str) -> HostError {
        let words = clean_lines(&self.streams.words());
        let why = if words.is_empty() { why.to_owned() } else { format!("{why}; {words}") };
        HostError::Unreachable { host: self.host.clone(), why }
    }

    pub(super) fn unfit(&self, answer: &Answer) -> HostError {
        let answer = short(&format!("{answer:?}"));
        let why =
            format!("it gave an answer to another request, {answer}; copy one version of sinew to all hosts");
        HostError::Refused { host: self.host.clone(), why }
    }
}

/// This program on another host.
struct RemoteProgram<'h> {
    folder: Option<&'h str>,
    hash: &'h Hash,
}

impl RemoteProgram<'_> {
    /// Returns the folder of programs, as the shell there reads it.
    fn folder(&self) -> String {
        let robots = self.folder.map_or_else(|| "\"$HOME/.local/state/sinew\"".to_owned(), quoted);
        format!("{robots}/tools")
    }

    /// Returns the command that runs this program there, for whichever shell the user has.
    fn run(&self) -> String {
        let path = format!("{}/sinew-{}", self.folder(), self.hash);
        let script = format!("f={path}; test -x \"$f\" || exit {LACKS_PROGRAM}; exec \"$f\" host");
        format!("exec sh -c {}", quoted(&script))
    }

    /// Returns the command that stores this program, of so many bytes, from its standard input.
    fn store(&self, bytes: u64) -> String {
        let (folder, hash) = (self.folder(), self.hash);
        let script = format!(
            "set -e; umask 077; d={folder}; mkdir -p \"$d\"; t=\"$d/.part-$$\"; trap 'rm -f \"$t\"' EXIT; cat > \"$t\"; \
             test \"$(wc -c < \"$t\")\" -eq {bytes}; chmod 700 \"$t\"; mv -f \"$t\" \"$d/sinew-{hash}\""
        );
        format!("exec sh -c {}", quoted(&script))
    }
}

/// Returns the command that runs `ssh`; the command there is its next argument.
fn ssh(host: &Host, destination: &str) -> Command {
    let mut ssh = Command::new("ssh");
    ssh.args(["-T", "-o", "BatchMode=yes", "-o"]).arg(format!("ConnectTimeout={CONNECT_S}"));
    // A connection that dies in silence ends within this time, too.
    ssh.args(["-o", "ServerAliveInterval=5", "-o", "ServerAliveCountMax=3"]);
    ssh.args(&host.ssh_options).arg("--").arg(destination);
    ssh
}

/// Copies this program to a host.
fn copy(
    host: &Host,
    destination: &str,
    remote: &RemoteProgram<'_>,
    (program, bytes): (&Path, u64),
) -> Result<(), String> {
    let failed = |error: io::Error| format!("{}: {error}", program.display());
    let mut command = ssh(host, destination);
    command.arg(remote.store(bytes));
    let mut streams = Streams::start(&mut command).map_err(|error| format!("ssh cannot be run: {error}"))?;
    let file = File::open(program).map_err(failed)?;
    // An ended connection is reported below, with its words.
    let _ = streams.write(Written::File(file, bytes));
    streams.close_input();
    let within = ENTERED_WITHIN + Duration::from_secs(bytes / BYTES_PER_SECOND);
    let code = streams.wait(within);
    if code == Some(0) {
        return Ok(());
    }
    let why = format!("the program sinew was not copied there; {}", clean_lines(&streams.words()));
    Err(explained(code, &why, destination))
}

/// Adds the remedy for an exit code.
fn explained(code: Option<i32>, why: &str, destination: &str) -> String {
    let remedy = match code {
        Some(SSH_FAILED) => format!("try it by hand: ssh -o BatchMode=yes {destination} true"),
        Some(126) => {
            "sinew is of another processor or system: name one for this host by `sinew` in its table"
                .to_owned()
        }
        Some(code) => format!("its shell ended with code {code}"),
        None => "is it running, and is its network up?".to_owned(),
    };
    format!("{why}; {remedy}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs a command of another host in a shell of this one.
    fn shell(command: &str) -> Command {
        let mut shell = Command::new("sh");
        shell.args(["-c", command]);
        shell
    }

    #[test]
    fn program_is_copied_whole_or_not_at_all() {
        let directory = sinew_testkit::TestDirectory::new();
        let folder = directory.join("a folder").display().to_string();
        let file = directory.write("program", "#!/bin/sh\necho it runs: $1\n");
        let (hash, bytes) = Hash::of_file(&file).expect("it was written just now");
        let remote = RemoteProgram { folder: Some(&folder), hash: &hash };
        let missing = shell(&remote.run()).status().expect("there is a shell");
        assert_eq!(missing.code(), Some(LACKS_PROGRAM));
        let copied = |bytes: u64| {
            let input = File::open(&file).expect("it was written just now");
            shell(&remote.store(bytes)).stdin(input).status().expect("there is a shell").success()
        };
        assert!(!copied(bytes + 1), "a connection that was cut must not leave a part");
        assert_eq!(shell(&remote.run()).status().expect("there is a shell").code(), Some(LACKS_PROGRAM));
        assert!(copied(bytes));
        let output = shell(&remote.run()).output().expect("there is a shell");
        assert_eq!(String::from_utf8_lossy(&output.stdout), "it runs: host\n");
    }

    #[test]
    fn failed_program_is_unreachable_with_its_words() {
        let mut session =
            Session::start("hip", &mut shell("echo no route >&2; exit 255")).expect("there is a shell");
        let why = session.ask(&Request::Sweep).expect_err("it answers nothing").to_string();
        assert!(why.starts_with("host hip is not reachable: ") && why.contains("no route"), "{why}");
        let why = explained(session.streams.wait(ENDED_WITHIN), "the connection has ended", "hip");
        assert!(why.ends_with("try it by hand: ssh -o BatchMode=yes hip true"), "{why}");
    }

    #[test]
    fn other_text_than_an_answer_is_shown() {
        let mut session = Session::start("hip", &mut shell("echo Welcome")).expect("there is a shell");
        let why = session.ask(&Request::Sweep).expect_err("it is no answer").to_string();
        assert!(why.contains("it answered: Welcome"), "{why}");
    }
}
