//! Keys of a project that exists for one run.

use std::{
    fs::{self, Permissions},
    io,
    net::{Ipv4Addr, TcpListener, TcpStream},
    os::unix::fs::PermissionsExt as _,
    path::{Path, PathBuf},
    sync::Arc,
    thread,
    time::Instant,
};

use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType};
use sinew::{
    NodeBuilder, NodeConfig,
    security::{
        Credentials, DiscoveryKey, Identity, TimePolicy, Tls, UnixTime, files, project_uri,
        rustls::{self, ClientConnection, ServerConnection, time_provider::DefaultTimeProvider},
    },
};
use sinew_figures::{Alone, Figures};

use crate::nodes::At;

/// The addresses of the two nodes of a run.
pub(crate) const FIRST: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 1);
pub(crate) const SECOND: Ipv4Addr = Ipv4Addr::new(127, 0, 0, 2);

/// The directory for the keys of this run. Its name contains the run's own port.
fn directory_of(at: At) -> PathBuf {
    std::env::temp_dir().join(format!("sinew-bench-keys-{}", at.port()))
}

/// Returns a node at `at` that finds no other node, with its keys if they exist.
pub(crate) fn node(at: At, name: &str) -> NodeBuilder {
    let directory = directory_of(at).join(name);
    at.node(name).configure(|config| config.security.keys = directory.exists().then_some(directory))
}

fn identity(name: &str, address: Ipv4Addr) -> Identity {
    let project = NodeConfig::new(name).project;
    Identity { project, address: address.into(), name: name.to_owned() }
}

/// The files of this run's nodes; they go with it.
pub(crate) struct Keys {
    directory: PathBuf,
}

impl Keys {
    pub(crate) fn make(at: At, nodes: &[(&str, Ipv4Addr)]) -> Self {
        Self::try_make(at, nodes).expect("the system's directory for temporary files can be written to")
    }

    fn try_make(at: At, nodes: &[(&str, Ipv4Addr)]) -> io::Result<Self> {
        let keys = Self { directory: directory_of(at) };
        fs::create_dir_all(&keys.directory)?;
        let project = NodeConfig::new("any").project;
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.subject_alt_names = vec![uri(&project_uri(&project))];
        let key = KeyPair::generate().map_err(io::Error::other)?;
        let authority = params.self_signed(&key).map_err(io::Error::other)?.pem();
        let issuer = Issuer::from_params(&params, &key);
        let discovery = DiscoveryKey::generate()?;
        for (name, address) in nodes {
            let mut params = CertificateParams::default();
            params.subject_alt_names = vec![uri(&identity(name, *address).uri())];
            params.extended_key_usages =
                vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
            let key = KeyPair::generate().map_err(io::Error::other)?;
            let certificate = params.signed_by(&key, &issuer).map_err(io::Error::other)?.pem();
            let directory = keys.directory.join(name);
            fs::create_dir(&directory)?;
            fs::set_permissions(&directory, Permissions::from_mode(0o700))?;
            put(&directory, files::NODE_KEY, 0o600, &key.serialize_pem())?;
            put(&directory, files::NODE_CERTIFICATE, 0o644, &certificate)?;
            put(&directory, files::AUTHORITY, 0o644, &authority)?;
            put(&directory, files::DISCOVERY_KEY, 0o600, &discovery.text())?;
            put(&directory, files::DENIED, 0o644, "")?;
        }
        Ok(keys)
    }

    fn tls(&self, name: &str, address: Ipv4Addr) -> Tls {
        let identity = identity(name, address);
        let directory = self.directory.join(name);
        let credentials = Credentials::load(&directory, &identity, TimePolicy::Ignored, UnixTime::now());
        Tls::new(&credentials.expect("they were just made"), Arc::new(DefaultTimeProvider))
            .expect("a key that was just made")
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        // Remaining files are in the system's directory for temporary files.
        let _ = fs::remove_dir_all(&self.directory);
    }
}

fn uri(text: &str) -> SanType {
    SanType::URI(text.try_into().expect("it is ASCII"))
}

fn put(directory: &Path, name: &str, mode: u32, text: &str) -> io::Result<()> {
    let path = directory.join(name);
    fs::write(&path, text)?;
    fs::set_permissions(&path, Permissions::from_mode(mode))
}

/// Measures the time until both ends of a TCP connection over loopback have authenticated each other, each on
/// its own thread.
pub(crate) fn measure_handshakes(count: usize) {
    let at = Ipv4Addr::LOCALHOST;
    let keys = Keys::make(At::loopback(), &[("hip", at), ("knee", at)]);
    let (hip, knee) = (keys.tls("hip", at), keys.tls("knee", at));
    let listener = TcpListener::bind((at, 0)).expect("a port on loopback");
    let address = listener.local_addr().expect("it is bound");
    let accepting = thread::spawn(move || {
        for _ in 0..count {
            let (mut socket, _) = listener.accept().expect("it is dialled");
            let mut tls = ServerConnection::new(knee.server()).expect("a configuration of ours");
            shake(&mut tls, &mut socket);
            knee.peer(&tls, None, UnixTime::now()).expect("the hip");
            // The dialler measures until this end is through, too.
            io::Write::write_all(&mut socket, &[1]).expect("it reads");
        }
    });
    let mut seen = Figures::new();
    for _ in 0..count {
        let mut socket = TcpStream::connect(address).expect("it listens");
        socket.set_nodelay(true).expect("a socket");
        let start = Instant::now();
        let mut tls =
            ClientConnection::new(hip.client(), Tls::server_name()).expect("a configuration of ours");
        shake(&mut tls, &mut socket);
        hip.peer(&tls, None, UnixTime::now()).expect("the knee");
        io::Read::read_exact(&mut socket, &mut [0]).expect("it says so");
        seen.record(start.elapsed());
    }
    accepting.join().expect("it does not panic");
    let figure = "time until both ends know who is there";
    Alone { bench: "gncl", case: "handshake", figure, seen: &seen, counts: &[("handshakes", count as u64)] }
        .report();
}

fn shake<D>(tls: &mut rustls::ConnectionCommon<D>, socket: &mut TcpStream) {
    while tls.is_handshaking() {
        tls.complete_io(socket).expect("the other end is of the project");
    }
}
