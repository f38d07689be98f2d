//! A project that exists for one test: an authority, certificates of any kind, a directory of files, a clock,
//! and a wire in memory.

#![allow(
    clippy::unwrap_used,
    clippy::new_without_default,
    reason = "a test that cannot make its project fails by that"
)]

use std::{
    fs::{self, Permissions},
    os::unix::fs::PermissionsExt,
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType,
};
use rustls::{ClientConfig, ClientConnection, CommonState, Error, ServerConfig, ServerConnection};
use rustls::{pki_types::UnixTime, time_provider::TimeProvider};

use crate::{Credentials, DiscoveryKey, Identity, TimePolicy, Tls, files as names, project_uri};

/// The time of the tests: 2026-11-22T15:13:00Z.
pub const NOW: u64 = 1_795_360_380;
pub const DAY: u64 = 24 * 3_600;

pub const fn at(seconds: u64) -> UnixTime {
    UnixTime::since_unix_epoch(Duration::from_secs(seconds))
}

/// A stopped clock.
#[derive(Debug)]
pub struct Clock(pub u64);

impl TimeProvider for Clock {
    fn current_time(&self) -> Option<UnixTime> {
        Some(at(self.0))
    }
}

pub fn identity(name: &str, last: u8) -> Identity {
    Identity { project: "walker".to_owned(), address: [192, 168, 0, last].into(), name: name.to_owned() }
}

/// An authority.
pub struct Authority {
    params: CertificateParams,
    key: KeyPair,
    pub pem: String,
    pub discovery: DiscoveryKey,
}

/// The contents of a certificate.
pub struct CertificateContent {
    pub uris: Vec<String>,
    pub from: u64,
    pub until: u64,
    pub usages: Vec<ExtendedKeyUsagePurpose>,
}

impl CertificateContent {
    /// As `sinew keys` makes it.
    pub fn of(identity: &Identity) -> Self {
        let usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        Self { uris: vec![identity.uri()], from: NOW - DAY, until: NOW + 365 * DAY, usages }
    }
}

/// A key and a certificate, PEM.
pub struct Pair {
    pub key: String,
    pub certificate: String,
}

impl Authority {
    pub fn new(project: &str) -> Self {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, project);
        params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
        params.subject_alt_names = vec![SanType::URI(project_uri(project).try_into().unwrap())];
        let origin = rcgen::date_time_ymd(1970, 1, 1);
        params.not_before = origin + Duration::from_secs(NOW - DAY);
        params.not_after = origin + Duration::from_secs(NOW + 7_300 * DAY);
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { params, key, pem, discovery: DiscoveryKey::generate().unwrap() }
    }

    pub fn sign(&self, content: &CertificateContent) -> Pair {
        let mut params = CertificateParams::default();
        params.subject_alt_names =
            content.uris.iter().map(|uri| SanType::URI(uri.as_str().try_into().unwrap())).collect();
        params.extended_key_usages = content.usages.clone();
        let origin = rcgen::date_time_ymd(1970, 1, 1);
        params.not_before = origin + Duration::from_secs(content.from);
        params.not_after = origin + Duration::from_secs(content.until);
        let key = KeyPair::generate().unwrap();
        let issuer = Issuer::from_params(&self.params, &self.key);
        let certificate = params.signed_by(&key, &issuer).unwrap().pem();
        Pair { key: key.serialize_pem(), certificate }
    }

    /// A node's directory with the files of `content`.
    pub fn directory(&self, content: &CertificateContent) -> Directory {
        let Pair { key, certificate } = self.sign(content);
        let directory = Directory::new();
        directory.put(names::NODE_KEY, 0o600, &key);
        directory.put(names::NODE_CERTIFICATE, 0o644, &certificate);
        directory.put(names::AUTHORITY, 0o644, &self.pem);
        directory.put(names::DISCOVERY_KEY, 0o600, &self.discovery.text());
        directory.put(names::DENIED, 0o644, "");
        directory
    }

    pub fn credentials(&self, name: &str, last: u8) -> Credentials {
        self.credentials_of(&identity(name, last))
    }

    pub fn credentials_of(&self, identity: &Identity) -> Credentials {
        load(&self.directory(&CertificateContent::of(identity)), identity)
    }

    /// A node's two ends, at [`NOW`].
    pub fn tls(&self, name: &str, last: u8) -> Tls {
        tls(&self.credentials(name, last))
    }
}

pub fn load(directory: &Directory, identity: &Identity) -> Credentials {
    Credentials::load(directory.path(), identity, TimePolicy::Strict, at(NOW)).unwrap()
}

pub fn tls(credentials: &Credentials) -> Tls {
    Tls::new(credentials, Arc::new(Clock(NOW))).unwrap()
}

/// A directory of a test's own, removed with it.
pub struct Directory(PathBuf);

impl Directory {
    pub fn new() -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = std::env::temp_dir().join(format!("sinew-keys-{}-{number}", std::process::id()));
        fs::create_dir(&path).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
        Self(path)
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    pub fn put(&self, name: &str, mode: u32, text: &str) {
        let path = self.0.join(name);
        fs::write(&path, text).unwrap();
        fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// Both ends of a connection, with a wire in memory between them.
pub struct Wire {
    pub client: ClientConnection,
    pub server: ServerConnection,
}

impl Wire {
    pub fn new(client: Arc<ClientConfig>, server: Arc<ServerConfig>) -> Self {
        Self {
            client: ClientConnection::new(client, Tls::server_name()).unwrap(),
            server: ServerConnection::new(server).unwrap(),
        }
    }

    /// Carries the output of either end until both are silent; returns each end's error, if it has one.
    pub fn run(&mut self) -> (Result<(), Error>, Result<(), Error>) {
        let (mut at_client, mut at_server) = (Ok(()), Ok(()));
        loop {
            let to_server = written(&mut self.client);
            let to_client = written(&mut self.server);
            if to_server.is_empty() && to_client.is_empty() {
                return (at_client, at_server);
            }
            at_server = at_server.and_then(|()| deliver(&mut self.server, &to_server));
            at_client = at_client.and_then(|()| deliver(&mut self.client, &to_client));
        }
    }
}

/// Returns the output of a connection.
pub fn written<D>(connection: &mut rustls::ConnectionCommon<D>) -> Vec<u8> {
    let mut bytes = Vec::new();
    while connection.wants_write() {
        connection.write_tls(&mut bytes).unwrap();
    }
    bytes
}

/// Delivers `bytes` to a connection.
pub fn deliver<D>(connection: &mut rustls::ConnectionCommon<D>, mut bytes: &[u8]) -> Result<(), Error> {
    while !bytes.is_empty() {
        // It stops reading when its buffer is full of incomplete input.
        if connection.read_tls(&mut bytes).unwrap_or(0) == 0 {
            break;
        }
        connection.process_new_packets()?;
    }
    Ok(())
}

pub fn is_open(connection: &CommonState) -> bool {
    !connection.is_handshaking()
}
