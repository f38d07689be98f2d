//! The host's side of `sinew up`: places files, starts and ends processes, and asks their nodes.
//!
//! The command `sinew host` runs it, on this host and, by `ssh`, on others. It serves one caller, and ends with it.
//! The nodes that it has started go on.

mod launch;
mod ports;
mod process;
mod store;

use std::{
    fs::File,
    io::{self, BufRead, Read as _, Seek as _, SeekFrom, Write},
    path::{Path, PathBuf},
    process::{Child, ExitCode},
    thread,
    time::Duration,
};

use super::{
    order::NodeOrder,
    protocol::{
        Answer, AppSeen, Apps, CONTENT_BYTES_MAX, LINE_BYTES_MAX, LOG_BYTES_MAX, NodeSeen, ProcessSeen,
        Request,
    },
};
use process::{Ended, ProcessId};
use store::{Record, Store, at};

/// Asks the node at a socket for its named applications.
pub(super) type Inspect = fn(&Path) -> Result<Vec<AppSeen>, String>;

/// Bytes at the end of a log that are read for its last lines, and the number of these.
const LAST_BYTES: u64 = 4 << 10;
const LAST_LINES: usize = 4;
/// Number of nodes that are asked beside each other.
const ASKED_AT_ONCE: usize = 16;

/// Becomes the program of a node: the second process of a start.
pub(super) fn launched() -> ExitCode {
    launch::launched()
}

/// Serves requests until their end.
///
/// # Errors
/// The streams cannot be read or written.
pub(super) fn serve(input: &mut dyn BufRead, output: &mut dyn Write, inspect: Inspect) -> io::Result<()> {
    let mut agent = Agent { store: None, children: Vec::new(), inspect };
    loop {
        let mut line = Vec::new();
        (&mut *input).take(LINE_BYTES_MAX).read_until(b'\n', &mut line)?;
        if line.is_empty() {
            return Ok(());
        }
        let answer = match serde_json::from_slice(&line) {
            Ok(request) => agent.handle(request, input).unwrap_or_else(Answer::Refused),
            Err(error) => Answer::Refused(format!(
                "the request is not readable: {error}; both programs have to be of one version"
            )),
        };
        let mut answer = serde_json::to_vec(&answer)?;
        answer.push(b'\n');
        output.write_all(&answer)?;
        output.flush()?;
    }
}

struct Agent {
    store: Option<Store>,
    /// Processes that this one has started: an ended one is waited for.
    children: Vec<Child>,
    inspect: Inspect,
}

impl Agent {
    fn handle(&mut self, request: Request, input: &mut dyn BufRead) -> Result<Answer, String> {
        if let Request::Enter { robot, folder, changes } = request {
            sinew::name::check_node_name(&robot)
                .map_err(|why| format!("no robot can be called {robot:?}: {why}"))?;
            let store = Store::open(&robot, folder.as_deref(), changes)?;
            let folder = store.robot().display().to_string();
            self.store = Some(store);
            return Ok(Answer::Entered { folder });
        }
        // The children's ends are seen by their process ids.
        self.children.retain_mut(|child| matches!(child.try_wait(), Ok(None)));
        let store = self.store.as_ref().ok_or("the first request has to enter a robot")?;
        match request {
            Request::Enter { .. } => Err("a robot was entered already".to_owned()),
            Request::Observe { asks } => self.observe(store, asks).map(Answer::Nodes),
            Request::Missing(hashes) => {
                Ok(Answer::Missing(hashes.into_iter().filter(|hash| !store.has(hash)).collect()))
            }
            Request::Put { hash, bytes } if bytes <= CONTENT_BYTES_MAX => {
                store.put(&hash, bytes, input).map(|()| Answer::Done(String::new()))
            }
            Request::Put { bytes, .. } => {
                Err(format!("{bytes} bytes are too many; a file has at most 4 GiB"))
            }
            Request::Check(order) => {
                ports::check(&order, &store.node(named(&order.name)?)).map(|()| Answer::Done(String::new()))
            }
            Request::Start(order) => {
                let child = start(store, order)?;
                let pid = child.id();
                self.children.push(child);
                Ok(Answer::Done(format!("process {pid}")))
            }
            Request::WriteUnit { order, unit } => write_unit(store, order, &unit),
            Request::WriteTarget(unit) => {
                let path = unit_path(store, "", "target");
                store.write(&path, unit.as_bytes())?;
                Ok(Answer::Done(path.display().to_string()))
            }
            Request::Stop { node, within_ms } => stop(store, named(&node)?, Duration::from_millis(within_ms)),
            Request::Remove { node } => remove(store, named(&node)?),
            Request::Sweep => store.sweep().map(|()| Answer::Done(String::new())),
            Request::Log { node, bytes_max } => {
                log(&store.log_path(named(&node)?), bytes_max.min(LOG_BYTES_MAX)).map(Answer::Log)
            }
        }
    }

    fn observe(&self, store: &Store, asks: bool) -> Result<Vec<NodeSeen>, String> {
        let (mut nodes, inspect) = (Vec::new(), self.inspect);
        for some in store.nodes()?.chunks(ASKED_AT_ONCE) {
            // A node that hangs delays only a part of the others.
            let seen: Vec<_> = thread::scope(|scope| {
                let observing: Vec<_> = some
                    .iter()
                    .map(|name| scope.spawn(move || observe_one(store, name, asks, inspect)))
                    .collect();
                let seen =
                    observing.into_iter().map(|thread| thread.join().expect("a question does not panic"));
                seen.collect()
            });
            for one in seen {
                nodes.extend(one?);
            }
        }
        Ok(nodes)
    }
}

/// Returns the state of a node; `None`: it has no record.
fn observe_one(store: &Store, name: &str, asks: bool, inspect: Inspect) -> Result<Option<NodeSeen>, String> {
    let Some(Record { order, process }) = store.record(name)? else { return Ok(None) };
    let process = running(process.as_ref(), name)?.map(|(id, _)| id);
    let last_lines = if process.is_some() { String::new() } else { last_lines(&store.log_path(name)) };
    let socket = order.socket.as_ref().filter(|_| asks && process.is_some());
    let apps = socket.map_or(Apps::NotAsked, |socket| match inspect(&store.node(name).join(socket)) {
        Ok(apps) => Apps::Listed(apps),
        Err(why) => Apps::Silent(why),
    });
    let process = process.map(|id| ProcessSeen { pid: id.pid, up_s: id.up_s() });
    Ok(Some(NodeSeen { order, process, last_lines, apps }))
}

/// Checks a name before it becomes a path.
fn named(name: &str) -> Result<&str, String> {
    match sinew::name::check_node_name(name) {
        Ok(()) => Ok(name),
        Err(why) => Err(format!("no node can be called {name:?}: {why}")),
    }
}

/// Returns the process of a record and its handle, if it runs.
fn running<'p>(
    process: Option<&'p ProcessId>,
    node: &str,
) -> Result<Option<(&'p ProcessId, std::os::fd::OwnedFd)>, String> {
    let Some(id) = process else { return Ok(None) };
    let handle = id.find().map_err(|error| {
        format!(
            "{node}: whether its process {} runs is not known: {error}; Linux 5.3 or later is needed",
            id.pid
        )
    })?;
    Ok(handle.map(|handle| (id, handle)))
}

fn start(store: &Store, order: NodeOrder) -> Result<Child, String> {
    let name = named(&order.name)?.to_owned();
    let before = store.record(&name)?.and_then(|record| record.process);
    if let Some((id, _)) = running(before.as_ref(), &name)? {
        return Err(format!("{name} runs already, as process {}; stop it first: sinew down", id.pid));
    }
    let folder = store.node(&name);
    let program = store.place(&order)?;
    let log = store.log(&name).map_err(|error| at(&store.log_path(&name), &error))?;
    store.write_record(&Record { order: order.clone(), process: None })?;
    let child = launch::start(&order, &program, &folder, log)?;
    let pid = i32::try_from(child.id()).unwrap_or_default();
    // One that has ended already has no identity, and needs none.
    store.write_record(&Record { order, process: ProcessId::of(pid) })?;
    Ok(child)
}

fn write_unit(store: &Store, order: NodeOrder, unit: &str) -> Result<Answer, String> {
    let name = named(&order.name)?.to_owned();
    store.place(&order)?;
    let process = store.record(&name)?.and_then(|record| record.process);
    store.write_record(&Record { order, process })?;
    let path = unit_path(store, &name, "service");
    store.write(&path, unit.as_bytes())?;
    Ok(Answer::Done(path.display().to_string()))
}

fn unit_path(store: &Store, node: &str, kind: &str) -> PathBuf {
    let robot = store.robot().file_name().unwrap_or_default().to_string_lossy();
    store.robot().join("units").join(super::units::unit_name(&robot, node, kind))
}

fn stop(store: &Store, node: &str, within: Duration) -> Result<Answer, String> {
    let Some(record) = store.record(node)? else {
        return Ok(Answer::Done("it has no files here".to_owned()));
    };
    let Some((id, handle)) = running(record.process.as_ref(), node)? else {
        return Ok(Answer::Done("it had ended".to_owned()));
    };
    let ended = process::end(&handle, within)
        .map_err(|error| format!("{node}: process {} does not end: {error}", id.pid))?;
    let note = match ended {
        Ended::InTime => format!("process {} has ended", id.pid),
        Ended::Killed => format!("process {} did not end within {within:?}, and was killed", id.pid),
    };
    Ok(Answer::Done(note))
}

/// Removes the files of a node, and the socket that a killed one left.
fn remove(store: &Store, node: &str) -> Result<Answer, String> {
    if let Some(record) = store.record(node)? {
        if let Some((id, _)) = running(record.process.as_ref(), node)? {
            return Err(format!(
                "{node} runs as process {}: its files stay; stop it first: sinew down",
                id.pid
            ));
        }
        if let Some(socket) = &record.order.socket {
            let path = store.node(node).join(socket);
            let refused = std::os::unix::net::UnixStream::connect(&path).err();
            if refused.is_some_and(|error| error.kind() == io::ErrorKind::ConnectionRefused) {
                // It may belong to another user, and blocks nothing then.
                let _ = std::fs::remove_file(&path);
            }
        }
    }
    let left = store.remove(node)?;
    let shown: Vec<_> = left.iter().map(|path| path.display().to_string()).collect();
    Ok(Answer::Done(if left.is_empty() {
        String::new()
    } else {
        format!("not made by `sinew up`: {}", shown.join(", "))
    }))
}

/// Returns the end of a log, from the beginning of a line on.
fn log(path: &Path, bytes_max: u64) -> Result<String, String> {
    let read = || -> io::Result<Vec<u8>> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        let begin = length.saturating_sub(bytes_max);
        file.seek(SeekFrom::Start(begin))?;
        let mut bytes = Vec::new();
        file.take(bytes_max).read_to_end(&mut bytes)?;
        let cut =
            if begin > 0 { bytes.iter().position(|byte| *byte == b'\n').map_or(0, |at| at + 1) } else { 0 };
        Ok(bytes.split_off(cut))
    };
    match read() {
        Ok(bytes) => Ok(String::from_utf8_lossy(&bytes).into_owned()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(String::new()),
        Err(error) => Err(at(path, &error)),
    }
}

fn last_lines(path: &Path) -> String {
    let text = log(path, LAST_BYTES).unwrap_or_default();
    let lines: Vec<_> = text.lines().collect();
    lines[lines.len().saturating_sub(LAST_LINES)..].join("\n")
}

#[cfg(test)]
mod tests;
