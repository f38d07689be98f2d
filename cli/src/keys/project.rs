//! The directory of a project's keys, on the machine where they are created.
//!
//! ```text
//! keys/                0700
//!   ca.key             0600   the authority's key: keep it off the robot
//!   ca.pem             0644   its certificate
//!   discovery.key      0600   the project's key for datagrams
//!   denied.txt         0644   the deny list
//!   issued/NUMBER.pem  0644   every certificate that was ever made: only these can be revoked
//!   nodes/NAME/        0700   the files for the node, copied as a whole
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
use crate::{system::SystemError, table::short, unknown::suggestion};

const AUTHORITY_KEY: &str = "ca.key";
const ISSUED: &str = "issued";
const NODES: &str = "nodes";
/// Maximum number of certificates of one project.
const ISSUED_MAX: usize = DenyList::SERIALS_MAX;
const HEADING: &str = "# Certificates that are revoked, one number a line. Made by `sinew keys revoke`; copy it to every node.\n";
const TRY_AGAIN: &str = "check the path, its owner and the room on the disk, and try again";

/// A project's keys, with the authority's key to create more of them.
pub(super) struct Project {
    directory: PathBuf,
    name: String,
    authority: Authority,
    /// Locks the directory against other writers.
    _lock: File,
}

/// A created certificate.
#[derive(Clone, Debug)]
pub(super) struct Issued {
    pub(super) identity: Identity,
    certificate: Certificate,
    /// Whether it is the current certificate of its node.
    pub(super) is_current: bool,
}

/// The created files, and their directory.
pub(super) struct CreatedProject {
    pub(super) directory: PathBuf,
    pub(super) project: String,
    /// When the authority's certificate ends, if that was created, too.
    pub(super) authority_until: Option<UnixTime>,
    pub(super) nodes: Vec<Issued>,
    /// Earlier certificates of the same nodes that are still valid.
    pub(super) older: Vec<Issued>,
}

/// The result of a revocation.
pub(super) struct Revoked {
    pub(super) now: Vec<Issued>,
    pub(super) before: Vec<Issued>,
    /// The certificates of the remaining nodes, to which the list must be copied.
    pub(super) left: Vec<Issued>,
}

/// The content of a directory of keys.
pub(super) struct ProjectStatus {
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

/// Creation.
impl Project {
    /// Creates a new project, completely or not at all.
    pub(super) fn init(
        project: &str,
        out: &Path,
        wanted: &[Wanted],
        clock: Clock,
    ) -> Result<CreatedProject, SystemError> {
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
        Ok(CreatedProject { directory: out.to_owned(), ..made })
    }

    fn fill(
        project: &str,
        directory: &Path,
        wanted: &[Wanted],
        clock: Clock,
    ) -> Result<CreatedProject, SystemError> {
        let (authority, pair) = Authority::make(project, clock).map_err(cryptography)?;
        let discovery = DiscoveryKey::generate().map_err(|why| SystemError::Keys(why.to_string()))?;
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
        Ok(CreatedProject { authority_until: Some(until), ..made })
    }

    /// Opens a project to change it.
    pub(super) fn open(directory: &Path) -> Result<Self, SystemError> {
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
        files::directory(directory).map_err(|why| SystemError::Keys(why.to_string()))?;
        let lock = lock(directory)?;
        let name = project_of(directory)?;
        let pem = files::secret(&key).map_err(|why| SystemError::Keys(why.to_string()))?;
        let pem = str::from_utf8(&pem).map_err(|why| fault(&key, why, "take it from your copy"))?;
        // The reader's error may contain lines of the key.
        let unreadable = |_| fault(&key, "no private key in PEM can be read here", "take it from your copy");
        let authority = Authority::read(&name, pem).map_err(unreadable)?;
        Ok(Self { directory: directory.to_owned(), name, authority, _lock: lock })
    }

    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Returns every certificate that was ever created.
    pub(super) fn issued(&self) -> Result<Vec<Issued>, SystemError> {
        issued(&self.directory)
    }

    /// Returns the certificates that are not revoked and have not ended.
    pub(super) fn counting(&self, now: UnixTime) -> Result<Vec<Issued>, SystemError> {
        let denied = denied(&self.directory)?.1;
        let counts = |issued: &Issued| issued.validity().until >= now && !denied.has(issued.serial());
        Ok(self.issued()?.into_iter().filter(counts).collect())
    }

    /// Creates a key and a certificate for each node, in its directory, each completely or not at all.
    pub(super) fn issue(&self, wanted: &[Wanted], clock: Clock) -> Result<CreatedProject, SystemError> {
        clock.must_end_before(certificate(&self.directory.join(AUTHORITY))?.validity().until)?;
        let names =
            |issued: &Issued| wanted.iter().any(|wanted| wanted.identity.name == issued.identity.name);
        let older = self.counting(clock.now)?.into_iter().filter(names).collect();
        let nodes =
            wanted.iter().map(|wanted| self.issue_one(&wanted.identity, clock)).collect::<Result<_, _>>()?;
        let (directory, project) = (self.directory.clone(), self.name.clone());
        Ok(CreatedProject { directory, project, authority_until: None, nodes, older })
    }

    fn issue_one(&self, identity: &Identity, clock: Clock) -> Result<Issued, SystemError> {
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
        // Checked as the node will check them.
        let credentials = Credentials::load(path, identity, TimePolicy::Strict, clock.now);
        let credentials =
            credentials.map_err(|why| SystemError::Keys(format!("what was made is not good:\n{why}")))?;
        let serial = credentials.serial().to_string();
        // First in the directory from which it can be revoked.
        put(&self.directory.join(ISSUED), &format!("{serial}.pem"), Readers::All, certificate.as_bytes())?;
        staged.replace(&target).map_err(failed)?;
        one(&self.directory.join(ISSUED).join(format!("{serial}.pem")))
    }
}

/// Revocation and inspection.
impl Project {
    /// Puts certificates on the deny list, by the names of their nodes or by their serial numbers.
    pub(super) fn revoke(&self, targets: &[String], now: UnixTime) -> Result<Revoked, SystemError> {
        let all = issued(&self.directory)?;
        let (text, denied) = denied(&self.directory)?;
        let mut chosen: Vec<Issued> = Vec::new();
        for word in targets {
            let serial: Option<Serial> = word.parse().ok();
            let is_meant =
                |issued: &&Issued| issued.identity.name == *word || Some(issued.serial()) == serial.as_ref();
            let meant: Vec<_> = all.iter().filter(is_meant).cloned().collect();
            if meant.is_empty() {
                let near = suggestion(word, all.iter().map(|issued| issued.identity.name.as_str()));
                return Err(SystemError::Unknown(format!(
                    "no certificate of `{}` was made here{near}; `sinew keys show` lists all. Nothing was revoked",
                    short(word)
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

    /// Returns the content of a project's directory, or of a node's.
    pub(super) fn status(directory: &Path) -> Result<ProjectStatus, SystemError> {
        let authority = certificate(&directory.join(AUTHORITY))?;
        let project = project_of(directory)?;
        let own = directory.join(NODE_CERTIFICATE);
        let issued = if own.exists() { vec![one(&own)?] } else { issued(directory)? };
        let denied = denied(directory)?.1;
        Ok(ProjectStatus { directory: directory.to_owned(), project, authority, issued, denied })
    }
}

fn put(directory: &Path, name: &str, readers: Readers, bytes: &[u8]) -> Result<(), SystemError> {
    let path = directory.join(name);
    write::file(&path, readers, bytes).map_err(|why| fault(&path, why, TRY_AGAIN))
}

fn cryptography(why: rcgen::Error) -> SystemError {
    SystemError::Keys(format!("no key or certificate can be made: {why}"))
}

fn lock(directory: &Path) -> Result<File, SystemError> {
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

fn certificate(path: &Path) -> Result<Certificate, SystemError> {
    Certificate::from_file(path).map_err(|why| SystemError::Keys(why.to_string()))
}

fn one(path: &Path) -> Result<Issued, SystemError> {
    let certificate = certificate(path)?;
    let identity = certificate
        .identity()
        .ok_or_else(|| fault(path, "this certificate names no node", "take it out of this directory"))?;
    Ok(Issued { identity, certificate, is_current: true })
}

/// Returns every certificate that was created, by name and then by age.
fn issued(directory: &Path) -> Result<Vec<Issued>, SystemError> {
    let paths = inside(&directory.join(ISSUED))?;
    let is_pem = |path: &&PathBuf| path.extension().is_some_and(|extension| extension == "pem");
    let mut all: Vec<_> = paths.iter().filter(is_pem).map(|path| one(path)).collect::<Result<_, _>>()?;
    // Two may have been created in one second: the one in the node's directory is the later one.
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

fn inside(directory: &Path) -> Result<Vec<PathBuf>, SystemError> {
    let failed = |why: io::Error| {
        fault(directory, why, "name the directory that `sinew keys init` made with --keys DIR")
    };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(directory).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        // An unfinished file of a `sinew keys` that was killed.
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

fn denied(directory: &Path) -> Result<(String, DenyList), SystemError> {
    let path = directory.join(DENIED);
    let remedy = "take it from your copy: without it, revoked certificates would be valid again";
    let text = std::fs::read_to_string(&path).map_err(|why| fault(&path, why, remedy))?;
    let list = DenyList::read(&text).map_err(|why| fault(&path, why, remedy))?;
    Ok((text, list))
}

fn project_of(directory: &Path) -> Result<String, SystemError> {
    let path = directory.join(AUTHORITY);
    let project = certificate(&path)?.project();
    project.ok_or_else(|| {
        fault(&path, "this is no certificate of a project's authority", "take it from your copy")
    })
}
