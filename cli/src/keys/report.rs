//! What `sinew keys` says: what was made, what is to be copied where, and which lines turn it on.

use std::{fmt::Write as _, net::Ipv4Addr, path::Path};

use serde_json::{Value, json};
use sinew::security::{
    UnixTime, date,
    files::{AUTHORITY, DENIED, DISCOVERY_KEY, NODE_CERTIFICATE, NODE_KEY},
};

use super::{
    project::{Issued, Look, Made, Revoked},
    targets::{AddressFrom, Wanted},
};
use crate::{
    Report,
    security::SOON_S,
    table::{Table, clean, quoted},
};

/// Where a node's directory is on its machine, unless somebody decides otherwise.
const INSTALLED: &str = "/etc/sinew/keys";
/// What is in it.
const FILES: [&str; 5] = [NODE_KEY, NODE_CERTIFICATE, AUTHORITY, DISCOVERY_KEY, DENIED];

/// Of `init` and `issue`.
pub(super) fn made(made: &Made, wanted: &[Wanted]) -> Report {
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
    let mut table = Table::new(["NODE", "ADDRESS", "", "UNTIL", "COPY"]);
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

fn made_json(made: &Made, wanted: &[Wanted]) -> Value {
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
        AddressFrom::Said => "as said".to_owned(),
        AddressFrom::File(path) => format!("from {}", path.display()),
        AddressFrom::Before => "as before".to_owned(),
        AddressFrom::Order => "next free here".to_owned(),
    }
}

fn directory_of(made: &Made, issued: &Issued) -> String {
    made.directory.join("nodes").join(&issued.identity.name).display().to_string()
}

/// Where the node looks for its keys: one of this machine takes them from where they were made.
fn installed(made: &Made, issued: &Issued) -> String {
    let here = directory_of(made, issued);
    if is_here(issued) {
        std::fs::canonicalize(&here).map_or(here, |path| path.display().to_string())
    } else {
        INSTALLED.to_owned()
    }
}

/// Whether the node's address is one that only this machine reaches.
fn is_here(issued: &Issued) -> bool {
    Ipv4Addr::from(issued.identity.address.bits()).is_loopback()
}

/// What copies a node's directory to its machine, over one that is there, for root whoever made it; `None` where it stays.
fn copy(made: &Made, issued: &Issued) -> Option<String> {
    sent(
        &directory_of(made, issued),
        (".", &FILES),
        issued,
        &format!("mkdir -p {INSTALLED} && chmod 700 {INSTALLED} && "),
    )
}

/// What has `what` of this directory, which are these files, unpacked on the node's machine, prepared by this; `None` where that is this one.
///
/// Each file gets its name when all have come whole: the beginning of a deny list is one, too, and a node may read it at any time. An archive
/// that is cut where a file begins is one of fewer files to `tar`.
fn sent(directory: &str, (what, files): (&str, &[&str]), issued: &Issued, prepared: &str) -> Option<String> {
    let (from, host) = (quoted(directory), issued.identity.address);
    let files = files.iter().fold(String::new(), |all, file| all + " new/" + file);
    let unpack = format!(
        "{prepared}cd {INSTALLED} && rm -rf new && mkdir new && tar -C new -xp --no-same-owner && ls{files} >/dev/null && sync && \
         mv -f new/* . && rmdir new && sync"
    );
    (!is_here(issued)).then(|| format!("  tar -C {from} -c {what} | ssh root@{host} '{unpack}'\n"))
}

/// What the node's configuration needs. Texts of JSON are texts of TOML. On a network it says the interface, as the default is loopback, where no
/// other host hears the node, and multicast DNS is off: keys are nothing to it.
fn configuration(made: &Made, issued: &Issued) -> String {
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

/// Of `revoke`.
pub(super) fn revoked(revoked: &Revoked, directory: &Path) -> Report {
    let mut text = String::new();
    let line = |issued: &Issued, word: &str| {
        let identity = &issued.identity;
        format!("{} ({}), number {}: {word}\n", clean(&identity.name), identity.address, issued.serial())
    };
    text.extend(revoked.now.iter().map(|issued| line(issued, "revoked")));
    text.extend(revoked.before.iter().map(|issued| line(issued, "was revoked already")));
    let list = directory.join("denied.txt");
    let _ = write!(
        text,
        "\nIt counts on a node when {} has been copied beside its keys, as to {INSTALLED}/denied.txt, and `sinew reload` was\n\
         run there, which ends its links with those; it is in each directory of {} already. Who has a revoked node's files still has the discovery key of the project, with which\n\
         datagrams can be made that pass for any node's: `sinew keys init` a new project where that matters. `sinew keys issue` gives the node a new certificate.\n",
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

/// What a certificate is good for.
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
    const fn word(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::EndsSoon => "good, ends soon",
            Self::Older => "good, not in use",
            Self::NotYet => "to come",
            Self::Ended => "ended",
            Self::Revoked => "revoked",
        }
    }

    fn of(issued: &Issued, look: &Look, now: UnixTime) -> Self {
        let validity = issued.validity();
        if look.denied.has(issued.serial()) {
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

/// Of `show`.
pub(super) fn shown(look: &Look, now: UnixTime) -> Report {
    let states: Vec<_> = look.issued.iter().map(|issued| (issued, State::of(issued, look, now))).collect();
    let has_good = |name: &str| {
        states.iter().any(|(issued, state)| issued.identity.name == name && *state == State::Good)
    };
    let authority = look.authority.validity();
    let is_fine = authority.until >= now && states.iter().all(|(issued, _)| has_good(&issued.identity.name));
    let mut table = Table::new(["NODE", "ADDRESS", "NUMBER", "FROM", "UNTIL", "IS"]);
    for (issued, state) in &states {
        table.row([
            issued.identity.name.clone(),
            issued.identity.address.to_string(),
            issued.serial().to_string(),
            date(&issued.validity().from),
            date(&issued.validity().until),
            state.word().to_owned(),
        ]);
    }
    let heading = format!(
        "Project {}, authority until {}; {} on the deny list\n\n",
        clean(&look.project),
        date(&authority.until),
        look.denied.len()
    );
    let certificates = states.iter().map(|(issued, state)| {
        let mut json = issued_json(issued);
        json["state"] = state.word().into();
        json["revoked"] = (*state == State::Revoked).into();
        json
    });
    let json = json!({
        "project": look.project,
        "directory": look.directory,
        "authority_until": date(&authority.until),
        "denied": look.denied.len(),
        "certificates": certificates.collect::<Vec<_>>(),
    });
    Report { text: heading + &table.text(), json, is_fine }
}
