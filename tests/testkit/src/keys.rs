//! Keys of robots for one scenario, as `sinew keys` makes them.

use std::{
    fs::{self, Permissions},
    io,
    os::unix::fs::PermissionsExt as _,
    path::Path,
};

use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType};
use sinew::security::{DiscoveryKey, Identity, files, project_uri};

/// The node's key again, for hand-written peers, which do not parse PEM.
pub const NODE_KEY_DER: &str = "node.der";

/// Creates an authority, and below `directory` one key directory per node, named like the node.
///
/// # Errors
/// A file cannot be written, or there is no randomness.
///
/// # Panics
/// If `nodes` belong to several projects, or to none.
pub fn make(directory: &Path, nodes: &[Identity]) -> io::Result<()> {
    let project = &nodes.first().expect("keys are for somebody").project;
    assert!(nodes.iter().all(|node| node.project == *project), "an authority is for one project");
    let mut params = CertificateParams::default();
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.subject_alt_names = vec![uri(&project_uri(project))];
    let key = KeyPair::generate().map_err(io::Error::other)?;
    let authority = params.self_signed(&key).map_err(io::Error::other)?.pem();
    let issuer = Issuer::from_params(&params, &key);
    let discovery = DiscoveryKey::generate()?;
    for node in nodes {
        let mut params = CertificateParams::default();
        params.subject_alt_names = vec![uri(&node.uri())];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let key = KeyPair::generate().map_err(io::Error::other)?;
        let certificate = params.signed_by(&key, &issuer).map_err(io::Error::other)?.pem();
        let directory = directory.join(&node.name);
        fs::create_dir_all(&directory)?;
        fs::set_permissions(&directory, Permissions::from_mode(0o700))?;
        put(&directory, files::NODE_KEY, 0o600, &key.serialize_pem())?;
        put(&directory, files::NODE_CERTIFICATE, 0o644, &certificate)?;
        put(&directory, files::AUTHORITY, 0o644, &authority)?;
        put(&directory, files::DISCOVERY_KEY, 0o600, &discovery.text())?;
        put(&directory, files::DENIED, 0o644, "")?;
        fs::write(directory.join(NODE_KEY_DER), key.serialize_der())?;
    }
    Ok(())
}

fn uri(text: &str) -> SanType {
    SanType::URI(text.try_into().expect("it is ASCII"))
}

/// Writes one of these files.
///
/// # Errors
/// The file cannot be written.
pub fn put(directory: &Path, name: &str, mode: u32, text: &str) -> io::Result<()> {
    let path = directory.join(name);
    fs::write(&path, text)?;
    fs::set_permissions(&path, Permissions::from_mode(mode))
}
