//! The directory of a project's keys, on the machine that makes them.
//!
//! ```text
//! keys/                0700
//!   ca.key             0600   the authority's key: keep it off the robot
//!   ca.pem             0644   its certificate
//!   discovery.key      0600   the project's key for datagrams
//!   denied.txt         0644   the deny list
//!   issued/NUMBER.pem  0644   every certificate that was ever made: what is not here cannot be revoked
//!   nodes/NAME/        0700   what goes to the node, as a whole
//! ```

use std::{
    fs::File,
    io,
    path::{Path, PathBuf},
};

use sinew::security::{
    Certificate, Credentials, DenyList, DiscoveryKey, Identity, Serial, TimePolicy, UnixTime, Validity, date,
    files::{self, AUTHORITY, DENIED, DISCOVERY_KEY, NODE_CERTIFICATE, NODE_KEY},
};

use super::{
    authority::{Authority, Clock, Pair},
    fault,
    targets::Wanted,
    write::{self, Readers, Staged},
};
use crate::system::Fault;

const AUTHORITY_KEY: &str = "ca.key";
const ISSUED: &str = "issued";
const NODES: &str = "nodes";
/// Certificates of one project at most.
const ISSUED_MAX: usize = DenyList::SERIALS_MAX;
const HEADING: &str = "# Certificates that are revoked, one number a line. Made by `sinew keys revoke`; copy it to every node.\n";
const TRY_AGAIN: &str = "check the path, its owner and the room on the disk, and try again";

/// A project's keys, for who may make more of them.
pub(super) struct Project {
    directory: PathBuf,
    name: String,
    authority: Authority,
    /// Nobody else changes the directory meanwhile.
    _lock: File,
}

/// A certificate that was made.
#[derive(Clone, Debug)]
pub(super) struct Issued {
    pub(super) identity: Identity,
    certificate: Certificate,
    /// It is the one that its node is to have now.
    pub(super) is_current: bool,
}

/// What was made, where.
pub(super) struct Made {
    pub(super) directory: PathBuf,
    pub(super) project: String,
    /// When the authority's certificate ends, where that was made, too.
    pub(super) authority_until: Option<UnixTime>,
    pub(super) nodes: Vec<Issued>,
    /// Those of the same nodes that count still.
    pub(super) older: Vec<Issued>,
}

/// What was revoked.
pub(super) struct Revoked {
    pub(super) now: Vec<Issued>,
    pub(super) before: Vec<Issued>,
    /// What those nodes have that are left: the list has to come to them.
    pub(super) left: Vec<Issued>,
}

/// What is in a directory of keys.
pub(super) struct Look {
    pub(super) directory: PathBuf,
    pub(super) project: String,
    pub(super) authority: Certificate,
    pub(super) issued: Vec<Issued>,
    pub(super) denied: DenyList,
}

impl Issued {
    pub(super) const fn serial(&self) -> &Serial {
        self.certificate.serial()
    }

    pub(super) const fn validity(&self) -> Validity {
        self.certificate.validity()
    }
}

/// Making.
impl Project {
    /// A new project, all or nothing.
    pub(super) fn init(project: &str, out: &Path, wanted: &[Wanted], clock: Clock) -> Result<Made, Fault> {
        let is_empty = std::fs::read_dir(out).map(|mut inside| inside.next().is_none());
        match is_empty {
            Ok(true) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Ok(false) if out.join(AUTHORITY_KEY).exists() => {
                let why = "there are keys of a project here already, and nothing is replaced";
                let remedy = "add nodes to it with `sinew keys issue NODE --keys DIR`, or name another directory with --out DIR";
                return Err(fault(out, why, remedy));
            }
            Ok(false) | Err(_) => {
                let why = "this is no empty directory, and nothing is replaced";
                return Err(fault(out, why, "name another one with --out DIR"));
            }
        }
        let failed = |why: io::Error| fault(out, why, TRY_AGAIN);
        let staged = Staged::beside(out).map_err(failed)?;
        let made = Self::fill(project, staged.path(), wanted, clock)?;
        staged.place(out).map_err(failed)?;
        Ok(Made { directory: out.to_owned(), ..made })
    }

    fn fill(project: &str, directory: &Path, wanted: &[Wanted], clock: Clock) -> Result<Made, Fault> {
        let (authority, pair) = Authority::make(project, clock).map_err(cryptography)?;
        let discovery = DiscoveryKey::generate().map_err(|why| Fault::Keys(why.to_string()))?;
        for name in [ISSUED, NODES] {
            let path = directory.join(name);
            write::directory(&path).map_err(|why| fault(&path, why, TRY_AGAIN))?;
        }
        put(directory, AUTHORITY_KEY, Readers::Owner, pair.key.as_bytes())?;
        put(directory, AUTHORITY, Readers::All, pair.certificate.as_bytes())?;
        put(directory, DISCOVERY_KEY, Readers::Owner, discovery.text().as_bytes())?;
        put(directory, DENIED, Readers::All, HEADING.as_bytes())?;
        let lock = lock(directory)?;
        let name = project.to_owned();
        let made =
            Self { directory: directory.to_owned(), name, authority, _lock: lock }.issue(wanted, clock)?;
        let until = certificate(&directory.join(AUTHORITY))?.validity().until;
        Ok(Made { authority_until: Some(until), ..made })
    }

    /// Opens a project to change it.
    pub(super) fn open(directory: &Path) -> Result<Self, Fault> {
        let key = directory.join(AUTHORITY_KEY);
        if !key.exists() {
            let why = "there is no key of an authority (ca.key) here";
            let remedy = if directory.join(AUTHORITY).exists() && directory.join(ISSUED).exists() {
                "the rest of the project is: put ca.key back from where you keep it, for as long as this takes"
            } else {
                "name the directory that `sinew keys init` made with --keys DIR"
            };
            return Err(fault(directory, why, remedy));
        }
        files::directory(directory).map_err(|why| Fault::Keys(why.to_string()))?;
        let lock = lock(directory)?;
        let name = project_of(directory)?;
        let pem = files::secret(&key).map_err(|why| Fault::Keys(why.to_string()))?;
        let pem = str::from_utf8(&pem).map_err(|why| fault(&key, why, "take it from your copy"))?;
        // The reason that its reader gives may have lines of it in it.
        let unreadable = |_| fault(&key, "no private key in PEM can be read here", "take it from your copy");
        let authority = Authority::read(&name, pem).map_err(unreadable)?;
        Ok(Self { directory: directory.to_owned(), name, authority, _lock: lock })
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Every certificate that was ever made.
    pub(super) fn issued(&self) -> Result<Vec<Issued>, Fault> {
        issued(&self.directory)
    }

    /// Those certificates that are not revoked and have not ended.
    pub(super) fn counting(&self, now: UnixTime) -> Result<Vec<Issued>, Fault> {
        let denied = denied(&self.directory)?.1;
        let counts = |issued: &Issued| issued.validity().until >= now && !denied.has(issued.serial());
        Ok(self.issued()?.into_iter().filter(counts).collect())
    }

    /// A key and a certificate for each node, in its directory. Each node's is there whole or not at all.
    pub(super) fn issue(&self, wanted: &[Wanted], clock: Clock) -> Result<Made, Fault> {
        clock.must_end_before(certificate(&self.directory.join(AUTHORITY))?.validity().until)?;
        let names =
            |issued: &Issued| wanted.iter().any(|wanted| wanted.identity.name == issued.identity.name);
        let older = self.counting(clock.now)?.into_iter().filter(names).collect();
        let nodes =
            wanted.iter().map(|wanted| self.issue_one(&wanted.identity, clock)).collect::<Result<_, _>>()?;
        let (directory, project) = (self.directory.clone(), self.name.clone());
        Ok(Made { directory, project, authority_until: None, nodes, older })
    }

    fn issue_one(&self, identity: &Identity, clock: Clock) -> Result<Issued, Fault> {
        let target = self.directory.join(NODES).join(&identity.name);
        let failed = |why: io::Error| fault(&target, why, TRY_AGAIN);
        let Pair { key, certificate } = self.authority.sign(identity, clock).map_err(cryptography)?;
        let staged = Staged::beside(&target).map_err(failed)?;
        let path = staged.path();
        put(path, NODE_KEY, Readers::Owner, key.as_bytes())?;
        put(path, NODE_CERTIFICATE, Readers::All, certificate.as_bytes())?;
        for (name, readers) in
            [(AUTHORITY, Readers::All), (DISCOVERY_KEY, Readers::Owner), (DENIED, Readers::All)]
        {
            let from = self.directory.join(name);
            let bytes = std::fs::read(&from).map_err(|why| fault(&from, why, "take it from your copy"))?;
            put(path, name, readers, &bytes)?;
        }
        // As the node will look at them.
        let credentials = Credentials::load(path, identity, TimePolicy::Strict, clock.now);
        let credentials =
            credentials.map_err(|why| Fault::Keys(format!("what was made is not good:\n{why}")))?;
        let serial = credentials.serial().to_string();
        // First of all where it can be revoked.
        put(&self.directory.join(ISSUED), &format!("{serial}.pem"), Readers::All, certificate.as_bytes())?;
        staged.replace(&target).map_err(failed)?;
        one(&self.directory.join(ISSUED).join(format!("{serial}.pem")))
    }
}

/// Revoking, and looking.
impl Project {
    /// Puts certificates on the deny list, by their nodes' names or by their numbers.
    pub(super) fn revoke(&self, whom: &[String], now: UnixTime) -> Result<Revoked, Fault> {
        let all = issued(&self.directory)?;
        let (text, denied) = denied(&self.directory)?;
        let mut chosen: Vec<Issued> = Vec::new();
        for word in whom {
            let serial: Option<Serial> = word.parse().ok();
            let is_meant =
                |issued: &&Issued| issued.identity.name == *word || Some(issued.serial()) == serial.as_ref();
            let meant: Vec<_> = all.iter().filter(is_meant).cloned().collect();
            if meant.is_empty() {
                return Err(Fault::Whom(format!(
                    "no certificate of '{word}' was made here; `sinew keys show` has all. Nothing was revoked"
                )));
            }
            let is_new = |issued: &Issued| chosen.iter().all(|chosen| chosen.serial() != issued.serial());
            let new: Vec<_> = meant.into_iter().filter(is_new).collect();
            chosen.extend(new);
        }
        let (before, new): (Vec<_>, Vec<_>) =
            chosen.into_iter().partition(|issued| denied.has(issued.serial()));
        let line = |issued: &Issued| {
            let Identity { name, address, .. } = &issued.identity;
            format!(
                "{}  # {} {address}, revoked {}\n",
                issued.serial(),
                crate::table::clean(name),
                date(&now)
            )
        };
        let added: String = new.iter().map(line).collect();
        let end = if text.is_empty() || text.ends_with('\n') { "" } else { "\n" };
        let text = format!("{text}{end}{added}");
        let list =
            DenyList::read(&text).map_err(|why| fault(&self.directory.join(DENIED), why, "correct it"))?;
        put(&self.directory, DENIED, Readers::All, text.as_bytes())?;
        for node in inside(&self.directory.join(NODES))?.iter().filter(|path| path.is_dir()) {
            put(node, DENIED, Readers::All, text.as_bytes())?;
        }
        let left = all.into_iter().filter(|one| one.is_current && !list.has(one.serial())).collect();
        Ok(Revoked { now: new, before, left })
    }

    /// What is in a project's directory, or in a node's.
    pub(super) fn look(directory: &Path) -> Result<Look, Fault> {
        let authority = certificate(&directory.join(AUTHORITY))?;
        let project = project_of(directory)?;
        let own = directory.join(NODE_CERTIFICATE);
        let issued = if own.exists() { vec![one(&own)?] } else { issued(directory)? };
        let denied = denied(directory)?.1;
        Ok(Look { directory: directory.to_owned(), project, authority, issued, denied })
    }
}

fn put(directory: &Path, name: &str, readers: Readers, bytes: &[u8]) -> Result<(), Fault> {
    let path = directory.join(name);
    write::file(&path, readers, bytes).map_err(|why| fault(&path, why, TRY_AGAIN))
}

fn cryptography(why: rcgen::Error) -> Fault {
    Fault::Keys(format!("no key or certificate can be made: {why}"))
}

fn lock(directory: &Path) -> Result<File, Fault> {
    let failed = |why: io::Error| fault(directory, why, TRY_AGAIN);
    let opened = File::open(directory).map_err(failed)?;
    let order = rustix::fs::FlockOperation::NonBlockingLockExclusive;
    rustix::fs::flock(&opened, order).map_err(|why| match why {
        rustix::io::Errno::WOULDBLOCK => {
            fault(directory, "another `sinew keys` is at work here", "wait until it has ended")
        }
        other => failed(other.into()),
    })?;
    Ok(opened)
}

fn certificate(path: &Path) -> Result<Certificate, Fault> {
    Certificate::from_file(path).map_err(|why| Fault::Keys(why.to_string()))
}

fn one(path: &Path) -> Result<Issued, Fault> {
    let certificate = certificate(path)?;
    let identity = certificate
        .identity()
        .ok_or_else(|| fault(path, "this certificate names no node", "take it out of this directory"))?;
    Ok(Issued { identity, certificate, is_current: true })
}

/// Every certificate that was made, by name and then by age.
fn issued(directory: &Path) -> Result<Vec<Issued>, Fault> {
    let paths = inside(&directory.join(ISSUED))?;
    let is_pem = |path: &&PathBuf| path.extension().is_some_and(|extension| extension == "pem");
    let mut all: Vec<_> = paths.iter().filter(is_pem).map(|path| one(path)).collect::<Result<_, _>>()?;
    // Two may have been made in one second: what is in the node's directory is the later one.
    for issued in &mut all {
        let own = directory.join(NODES).join(&issued.identity.name).join(NODE_CERTIFICATE);
        issued.is_current = own.exists() && one(&own)?.serial() == issued.serial();
    }
    all.sort_by(|a, b| {
        let key = |issued: &Issued| (issued.identity.name.clone(), issued.validity().from, issued.is_current);
        key(a).cmp(&key(b)).then(a.serial().cmp(b.serial()))
    });
    Ok(all)
}

fn inside(directory: &Path) -> Result<Vec<PathBuf>, Fault> {
    let failed = |why: io::Error| {
        fault(directory, why, "name the directory that `sinew keys init` made with --keys DIR")
    };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        // Begun by a `sinew keys` that was killed.
        if path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b".")) {
            continue;
        }
        paths.push(path);
        if paths.len() > ISSUED_MAX {
            let why = format!("there are more than {ISSUED_MAX} files here");
            return Err(fault(directory, why, "move those of certificates that have ended elsewhere"));
        }
    }
    Ok(paths)
}

fn denied(directory: &Path) -> Result<(String, DenyList), Fault> {
    let path = directory.join(DENIED);
    let remedy = "take it from your copy: without it, what is revoked would count again";
    let text = std::fs::read_to_string(&path).map_err(|why| fault(&path, why, remedy))?;
    let list = DenyList::read(&text).map_err(|why| fault(&path, why, remedy))?;
    Ok((text, list))
}

fn project_of(directory: &Path) -> Result<String, Fault> {
    let path = directory.join(AUTHORITY);
    let project = certificate(&path)?.project();
    project.ok_or_else(|| {
        fault(&path, "this is no certificate of a project's authority", "take it from your copy")
    })
}
