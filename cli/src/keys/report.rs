//! The output of `sinew keys`: the created files, the commands to copy them, and the configuration lines that enable
//! them.

use std::{fmt::Write as _, net::Ipv4Addr, path::Path};

use serde_json::{Value, json};
use sinew::security::{
    UnixTime, date,
    files::{AUTHORITY, DENIED, DISCOVERY_KEY, NODE_CERTIFICATE, NODE_KEY},
};

use super::{
    project::{CreatedProject, Issued, ProjectStatus, Revoked},
    targets::{AddressFrom, Wanted},
};
use crate::{
    Report,
    security::SOON_S,
    table::{Table, clean, quoted},
};

/// The default directory of a node's keys on its machine.
const INSTALLED: &str = "/etc/sinew/keys";
/// Its files.
const FILES: [&str; 5] = [NODE_KEY, NODE_CERTIFICATE, AUTHORITY, DISCOVERY_KEY, DENIED];

/// The report of `init` and `issue`.
pub(super) fn made(made: &CreatedProject, wanted: &[Wanted], is_wide: bool) -> Report {
    let shown = made.directory.display();
    let mut text = String::new();
    if let Some(until) = made.authority_until {
        let _ = write!(
            text,
            "The authority of project {} is made; it is valid until {}. Anyone with {shown}/ca.key can make nodes of this robot:\n\
             keep it off the robot, and a copy of {shown} in a safe place.\n\n",
            clean(&made.project),
            date(&until)
        );
    }
    let heading = ["NODE", "ADDRESS", "ADDRESS FROM", "UNTIL", "COPY"];
    let mut table = Table::new(heading).whole(&["ADDRESS", "UNTIL"]).wide(is_wide);
    for (issued, wanted) in made.nodes.iter().zip(wanted) {
        table.row([
            issued.identity.name.clone(),
            issued.identity.address.to_string(),
            source(&wanted.address_from),
            date(&issued.validity().until),
            directory_of(made, issued),
        ]);
    }
    text += &table.text();
    let copies: String = made.nodes.iter().filter_map(|issued| copy(made, issued)).collect();
    if !copies.is_empty() {
        let _ = write!(
            text,
            "\nCopy each of these directories as a whole to its node's machine, with its modes (0700, and 0600 for node.key and\n\
             discovery.key), owned by the user who runs the node or by root. For example:\n{copies}"
        );
    }
    text += "\nThese lines in the node's configuration turn it on:\n";
    for issued in &made.nodes {
        text += "\n";
        configuration(made, issued).lines().for_each(|line| {
            let _ = writeln!(text, "  {line}");
        });
    }
    for older in &made.older {
        let Issued { identity, .. } = older;
        let _ = write!(
            text,
            "\n{} ({}) has an older certificate that is valid until {}: if its key was lost, `sinew keys revoke {} --keys {shown}`\n",
            clean(&identity.name),
            identity.address,
            date(&older.validity().until),
            older.serial()
        );
    }
    Report { text, json: made_json(made, wanted), is_fine: true }
}

fn made_json(made: &CreatedProject, wanted: &[Wanted]) -> Value {
    let node = |(issued, wanted): (&Issued, &Wanted)| {
        json!({
            "name": issued.identity.name,
            "address": issued.identity.address.to_string(),
            "address_from": source(&wanted.address_from),
            "number": issued.serial().to_string(),
            "from": date(&issued.validity().from),
            "until": date(&issued.validity().until),
            "copy": directory_of(made, issued),
            "to": installed(made, issued),
            "configuration": configuration(made, issued),
        })
    };
    let nodes: Vec<_> = made.nodes.iter().zip(wanted).map(node).collect();
    let older: Vec<_> = made.older.iter().map(issued_json).collect();
    json!({
        "project": made.project,
        "directory": made.directory,
        "authority_until": made.authority_until.as_ref().map(date),
        "nodes": nodes,
        "older": older,
    })
}

fn source(from: &AddressFrom) -> String {
    match from {
        AddressFrom::Given => "as given".to_owned(),
        AddressFrom::File(path) => format!("from {}", path.display()),
        AddressFrom::Before => "as before".to_owned(),
        AddressFrom::Order => "next free here".to_owned(),
    }
}

fn directory_of(made: &CreatedProject, issued: &Issued) -> String {
    made.directory.join("nodes").join(&issued.identity.name).display().to_string()
}

/// Returns where the node looks for its keys: a node of this machine uses the directory in which they were created.
fn installed(made: &CreatedProject, issued: &Issued) -> String {
    let here = directory_of(made, issued);
    if is_here(issued) {
        std::fs::canonicalize(&here).map_or(here, |path| path.display().to_string())
    } else {
        INSTALLED.to_owned()
    }
}

/// Returns whether only this machine can reach the node's address.
fn is_here(issued: &Issued) -> bool {
    Ipv4Addr::from(issued.identity.address.bits()).is_loopback()
}

/// Returns the command that copies a node's directory to its machine, replacing an existing one, owned by root; `None`
/// if it stays.
fn copy(made: &CreatedProject, issued: &Issued) -> Option<String> {
    sent(
        &directory_of(made, issued),
        (".", &FILES),
        issued,
        &format!("mkdir -p {INSTALLED} && chmod 700 {INSTALLED} && "),
    )
}

/// Returns the command that unpacks `what` from this directory, with these files, on the node's machine, after
/// `prepared`; `None` for this machine.
///
/// Each file gets its name only when all have arrived completely. The start of a deny list is a valid list, too, and a
/// node may read it at any time. For `tar`, an archive cut at a file's start is a valid archive with fewer files.
fn sent(directory: &str, (what, files): (&str, &[&str]), issued: &Issued, prepared: &str) -> Option<String> {
    let (from, host) = (quoted(directory), issued.identity.address);
    let files = files.iter().fold(String::new(), |all, file| all + " new/" + file);
    let unpack = format!(
        "{prepared}cd {INSTALLED} && rm -rf new && mkdir new && tar -C new -xp --no-same-owner && ls{files} >/dev/null && sync && \
         mv -f new/* . && rmdir new && sync"
    );
    (!is_here(issued)).then(|| format!("  tar -C {from} -c {what} | ssh root@{host} '{unpack}'\n"))
}

/// Returns the lines for the node's configuration. JSON strings are valid TOML strings. On a network they set the
/// interface, because the default is loopback, where other hosts cannot reach the node. They disable multicast DNS,
/// which keys do not protect.
fn configuration(made: &CreatedProject, issued: &Issued) -> String {
    let text = |text: &str| Value::from(text).to_string();
    let identity = &issued.identity;
    let discovery = if is_here(issued) {
        String::new()
    } else {
        let own = identity.address;
        format!("[ndl]\ninterface = \"{own}\"  # an address of the node's own host\nmdns_port = false\n")
    };
    format!(
        "[node]\nname = {}\nproject = {}\naddress = \"{}\"\n{discovery}[security]\nkeys = {}\n",
        text(&identity.name),
        text(&identity.project),
        identity.address,
        text(&installed(made, issued))
    )
}

/// The report of `revoke`.
pub(super) fn revoked(revoked: &Revoked, directory: &Path) -> Report {
    let mut text = String::new();
    let line = |issued: &Issued, state: &str| {
        let identity = &issued.identity;
        format!("{} ({}), number {}: {state}\n", clean(&identity.name), identity.address, issued.serial())
    };
    text.extend(revoked.now.iter().map(|issued| line(issued, "revoked")));
    text.extend(revoked.before.iter().map(|issued| line(issued, "was revoked already")));
    let list = directory.join("denied.txt");
    let _ = write!(
        text,
        "\nThe list takes effect on a node when {} has been copied beside its keys, as to {INSTALLED}/denied.txt, and `sinew reload` was\n\
         run there, which ends its links with those; it is in each directory of {} already. The files of a revoked node hold the discovery key of\n\
         the project, with which datagrams can be made that pass for any node's: `sinew keys init` a new project where that matters. `sinew keys issue` gives the node a new certificate.\n",
        list.display(),
        directory.join("nodes").display()
    );
    let shown = directory.display().to_string();
    let copies = revoked.left.iter().filter_map(|issued| sent(&shown, (DENIED, &[DENIED]), issued, ""));
    let copies: Vec<_> = copies.collect();
    if !copies.is_empty() {
        let _ = write!(text, "\nTo the nodes that are left, for example:\n{}", copies.concat());
    }
    let json = json!({
        "revoked": revoked.now.iter().map(issued_json).collect::<Vec<_>>(),
        "revoked_before": revoked.before.iter().map(issued_json).collect::<Vec<_>>(),
        "copy": list,
        "to": format!("{INSTALLED}/denied.txt"),
        "nodes": revoked.left.iter().map(issued_json).collect::<Vec<_>>(),
    });
    Report { text, json, is_fine: true }
}

fn issued_json(issued: &Issued) -> Value {
    json!({
        "name": issued.identity.name,
        "address": issued.identity.address.to_string(),
        "number": issued.serial().to_string(),
        "from": date(&issued.validity().from),
        "until": date(&issued.validity().until),
    })
}

/// The validity of a certificate.
#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    Good,
    EndsSoon,
    Older,
    NotYet,
    Ended,
    Revoked,
}

impl State {
    const fn name(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::EndsSoon => "good, ends soon",
            Self::Older => "good, not in use",
            Self::NotYet => "to come",
            Self::Ended => "ended",
            Self::Revoked => "revoked",
        }
    }

    fn of(issued: &Issued, status: &ProjectStatus, now: UnixTime) -> Self {
        let validity = issued.validity();
        if status.denied.has(issued.serial()) {
            Self::Revoked
        } else if validity.until < now {
            Self::Ended
        } else if validity.from > now {
            Self::NotYet
        } else if !issued.is_current {
            Self::Older
        } else if validity.until.as_secs() - now.as_secs() < SOON_S {
            Self::EndsSoon
        } else {
            Self::Good
        }
    }
}

/// Returns a table with all columns, or with those that fit a terminal.
fn table(states: &[(&Issued, State)], is_wide: bool) -> String {
    let mut all = Table::new(["NODE", "ADDRESS", "NUMBER", "FROM", "UNTIL", "STATE"]).wide(true);
    let mut short = Table::new(["NODE", "ADDRESS", "NUMBER", "UNTIL", "STATE"])
        .whole(&["ADDRESS", "NUMBER", "UNTIL", "STATE"]);
    for (issued, state) in states {
        let Issued { identity, .. } = issued;
        let (name, address) = (identity.name.clone(), identity.address.to_string());
        let (number, until) = (issued.serial().to_string(), date(&issued.validity().until));
        let state = state.name().to_owned();
        let from = date(&issued.validity().from);
        if is_wide {
            all.row([name, address, number, from, until, state]);
        } else {
            short.row([name, address, number, until, state]);
        }
    }
    if is_wide { all.text() } else { short.text() }
}

/// The report of `show`.
pub(super) fn shown(status: &ProjectStatus, now: UnixTime, is_wide: bool) -> Report {
    let states: Vec<_> =
        status.issued.iter().map(|issued| (issued, State::of(issued, status, now))).collect();
    let has_good = |name: &str| {
        states.iter().any(|(issued, state)| issued.identity.name == name && *state == State::Good)
    };
    let authority = status.authority.validity();
    let is_fine = authority.until >= now && states.iter().all(|(issued, _)| has_good(&issued.identity.name));
    let table = table(&states, is_wide);
    let heading = format!(
        "Project {}, authority until {}; {} on the deny list\n\n",
        clean(&status.project),
        date(&authority.until),
        status.denied.len()
    );
    let certificates = states.iter().map(|(issued, state)| {
        let mut json = issued_json(issued);
        json["state"] = state.name().into();
        json["revoked"] = (*state == State::Revoked).into();
        json
    });
    let json = json!({
        "project": status.project,
        "directory": status.directory,
        "authority_until": date(&authority.until),
        "denied": status.denied.len(),
        "certificates": certificates.collect::<Vec<_>>(),
    });
    Report { text: heading + &table, json, is_fine }
}
