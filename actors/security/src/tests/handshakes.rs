//! Accepted and rejected nodes, and the error at each end.

use std::sync::Arc;

use rcgen::ExtendedKeyUsagePurpose;
use rustls::{ClientConfig, ServerConfig, client::Resumption, version::TLS12};

use crate::{
    Credentials, Judged, PROTOCOL, PeerError, TimePolicy, Tls, ValidityError, files as names,
    testing::{
        Authority, CertificateContent, Clock, DAY, Directory, NOW, Wire, at, identity, is_open, load, tls,
    },
    tls::provider,
    words,
};

/// The hip dials the knee.
fn between(hip: &Tls, knee: &Tls) -> Wire {
    Wire::new(hip.client(), knee.server())
}

/// Returns the text of the error with which an end rejected the other one.
fn refusal(result: Result<(), rustls::Error>) -> String {
    words(&result.expect_err("the other end is not taken"))
}

#[test]
fn nodes_of_one_project_authenticate_each_other() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = between(&hip, &knee);
    // No peer is known before the handshake is complete.
    assert_eq!(knee.peer(&wire.server, None, at(NOW)), Err(PeerError::Unfinished));
    // When
    assert_eq!(wire.run(), (Ok(()), Ok(())));
    // Then: each knows the other's identity
    let at_hip = hip.peer(&wire.client, Some([192, 168, 0, 12].into()), at(NOW)).unwrap();
    let at_knee = knee.peer(&wire.server, Some([192, 168, 0, 11].into()), at(NOW)).unwrap();
    assert_eq!((at_hip.identity, at_hip.times), (identity("knee", 12), Judged::Valid));
    assert_eq!((at_knee.identity.clone(), at_knee.warning()), (identity("hip", 11), None));
    // And: TLS 1.3, with nothing that could be used again
    assert_eq!(wire.client.protocol_version(), Some(rustls::ProtocolVersion::TLSv1_3));
    assert_eq!(wire.client.handshake_kind(), Some(rustls::HandshakeKind::Full));
    assert_eq!(wire.client.tls13_tickets_received(), 0);
    let mut again = between(&hip, &knee);
    assert_eq!(again.run(), (Ok(()), Ok(())));
    assert_eq!(again.client.handshake_kind(), Some(rustls::HandshakeKind::Full));
}

#[test]
fn node_of_another_project_is_rejected() {
    // Given: two projects with the same name and different authorities, as in two laboratories
    let (hip, knee) = (Authority::new("walker").tls("hip", 11), Authority::new("walker").tls("knee", 12));
    // When
    let (at_client, _) = between(&hip, &knee).run();
    // Then: the dialling end reports it
    let text = refusal(at_client);
    assert!(text.contains("not from this project's authority"), "{text}");
    // And: a dialling node that accepts any server is rejected by the other end
    let mut wire = Wire::new(accept_any(&hip, Some(&hip)), knee.server());
    let (at_client, at_server) = wire.run();
    let text = refusal(at_server);
    assert!(
        text.contains("not from this project's authority") && text.contains("sinew keys issue"),
        "{text}"
    );
    let text = refusal(at_client);
    assert!(text.contains("does not take this node's certificate; its log says why"), "{text}");
    assert!(knee.peer(&wire.server, None, at(NOW)).is_err());
}

#[test]
fn missing_certificate_is_rejected() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = Wire::new(accept_any(&hip, None), knee.server());
    let (at_client, at_server) = wire.run();
    let text = refusal(at_server);
    assert!(text.contains("shows no certificate") && text.contains("sinew keys issue"), "{text}");
    let text = refusal(at_client);
    assert!(text.contains("got no certificate from here"), "{text}");
    assert!(!is_open(&wire.server) && knee.peer(&wire.server, None, at(NOW)).is_err());
}

#[test]
fn certificate_without_its_key_is_rejected() {
    // Given: the hip's certificate, which is public on the network, with another key
    let walker = Authority::new("walker");
    let knee = walker.tls("knee", 12);
    let mut stolen = walker.credentials("hip", 11);
    stolen.key = walker.credentials("ankle", 13).key;
    // Then: rustls itself does not accept them as a pair
    assert!(Tls::new(&stolen, Arc::new(Clock(NOW))).is_err());
    // And: a node that signs with the other key anyway is rejected
    let resolver = MismatchedKey::new(&stolen);
    let mut client = (*accept_any(&knee, None)).clone();
    client.client_auth_cert_resolver = Arc::new(resolver);
    let (_, at_server) = Wire::new(Arc::new(client), knee.server()).run();
    let text = refusal(at_server);
    assert!(text.contains("does not hold the key"), "{text}");
}

#[test]
fn stolen_keys_do_not_impersonate_another_node() {
    // Given: an attacker with the ankle's keys that claims to be the knee
    let walker = Authority::new("walker");
    let (hip, ankle) = (walker.tls("hip", 11), walker.tls("ankle", 13));
    let mut wire = between(&hip, &ankle);
    assert_eq!(wire.run(), (Ok(()), Ok(())));
    // When: the hip wants the knee
    let fault = hip.peer(&wire.client, Some([192, 168, 0, 12].into()), at(NOW)).unwrap_err();
    // Then
    let expected =
        PeerError::SomebodyElse { identity: identity("ankle", 13), expected: [192, 168, 0, 12].into() };
    assert_eq!(fault, expected);
    let text = fault.to_string();
    assert!(text.contains("192.168.0.13") && text.contains("where 192.168.0.12 was to be"), "{text}");
}

#[test]
fn revoked_certificate_is_rejected_at_both_ends() {
    let walker = Authority::new("walker");
    let ankle = walker.credentials("ankle", 13);
    let own = identity("hip", 11);
    let directory = walker.directory(&CertificateContent::of(&own));
    directory.put(names::DENIED, 0o644, &format!("{}  # ankle\n", ankle.serial()));
    let (hip, ankle) = (tls(&load(&directory, &own)), tls(&ankle));
    let (at_client, _) = between(&hip, &ankle).run();
    let (_, at_server) = between(&ankle, &hip).run();
    for text in [refusal(at_client), refusal(at_server)] {
        assert!(text.contains("\"ankle\" (192.168.0.13)") && text.contains("is revoked"), "{text}");
    }
    // And: others of the same authority are not
    assert_eq!(between(&hip, &walker.tls("knee", 12)).run(), (Ok(()), Ok(())));
}

/// A node with a certificate that is valid from `from` to `until`, under a policy, with a clock.
fn timed(walker: &Authority, name: &str, [from, until]: [u64; 2], policy: TimePolicy, now: u64) -> Tls {
    let own = identity(name, 20);
    let directory = walker.directory(&CertificateContent { from, until, ..CertificateContent::of(&own) });
    let mut credentials = Credentials::load(directory.path(), &own, TimePolicy::Ignored, at(now)).unwrap();
    credentials.trust.policy = policy;
    Tls::new(&credentials, Arc::new(Clock(now))).unwrap()
}

const USUAL: [u64; 2] = [NOW - DAY, NOW + DAY];

#[test]
fn expired_or_future_certificate_is_rejected_at_both_ends() {
    let walker = Authority::new("walker");
    let hip = walker.tls("hip", 11);
    for (times, part) in [
        ([NOW - 2 * DAY, NOW - 1], "it ended on 2026-11-22T"),
        ([NOW + 3_600, NOW + DAY], "it counts from 2026-11-22T"),
    ] {
        let other = timed(&walker, "old", times, TimePolicy::Ignored, NOW);
        let (at_client, _) = between(&hip, &other).run();
        let (_, at_server) = between(&other, &hip).run();
        for text in [refusal(at_client), refusal(at_server)] {
            assert!(text.contains("\"old\" (192.168.0.20)") && text.contains(part), "{text}");
        }
        // And: it ends in the middle of a connection
        let (mut wire, open) = (between(&hip, &walker.tls("knee", 12)), at(NOW + 366 * DAY));
        assert_eq!(wire.run(), (Ok(()), Ok(())));
        let fault = hip.peer(&wire.client, None, open).unwrap_err();
        assert!(matches!(fault, PeerError::Times { why: ValidityError::Over { .. }, .. }), "{fault}");
    }
}

#[test]
fn unset_clock_follows_the_policy_with_a_warning() {
    let walker = Authority::new("walker");
    let knee = walker.tls("knee", 12);
    for (policy, taken) in [
        (TimePolicy::Strict, None),
        (TimePolicy::UntilSet, Some(Judged::ClockNotSet)),
        (TimePolicy::Ignored, Some(Judged::NotLookedAt)),
    ] {
        // Given: a robot that has just booted
        let robot = timed(&walker, "robot", USUAL, policy, 12);
        let mut wire = between(&robot, &knee);
        let (at_client, _) = wire.run();
        // Then
        let Some(times) = taken else {
            let text = refusal(at_client);
            assert!(text.contains("1970-01-01T00:00:12Z") && text.contains("the clock is not set"), "{text}");
            continue;
        };
        assert_eq!(at_client, Ok(()), "{policy:?}");
        let peer = robot.peer(&wire.client, None, at(12)).unwrap();
        assert_eq!(peer.times, times);
        assert!(peer.warning().is_some_and(|words| words.contains("\"knee\"")), "it is reported");
    }
    // And: a certificate that expired before the robot's own was made is rejected in 1970, too
    let robot = timed(&walker, "robot", USUAL, TimePolicy::UntilSet, 12);
    let gone = timed(&walker, "gone", [NOW - 3 * DAY, NOW - 2 * DAY], TimePolicy::Ignored, NOW);
    let text = refusal(between(&robot, &gone).run().0);
    assert!(text.contains("it ended on 2026-11-20"), "{text}");
}

#[test]
fn tls_1_2_is_rejected_at_both_ends() {
    let walker = Authority::new("walker");
    let hip = walker.tls("hip", 11);
    let (client, server) = of_version_1_2(&walker.credentials("knee", 12));
    let (at_client, at_server) = Wire::new(client, hip.server()).run();
    for text in [refusal(at_server), refusal(at_client)] {
        assert!(text.contains("does not speak TLS 1.3"), "{text}");
    }
    let (at_client, at_server) = Wire::new(hip.client(), server).run();
    assert!(at_server.is_err());
    let text = refusal(at_client);
    assert!(text.contains("does not speak TLS 1.3"), "{text}");
}

#[test]
fn other_or_missing_alpn_is_rejected() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    for protocols in [vec![], vec![b"sinew/2".to_vec()], vec![b"http/1.1".to_vec()]] {
        let (mut client, mut server) = ((*hip.client()).clone(), (*hip.server()).clone());
        client.alpn_protocols.clone_from(&protocols);
        server.alpn_protocols.clone_from(&protocols);
        // Dialled by such a client
        let mut wire = Wire::new(Arc::new(client), knee.server());
        let (_, at_server) = wire.run();
        let text = at_server.map_or_else(
            |error| words(&error),
            |()| {
                knee.peer(&wire.server, None, at(NOW))
                    .expect_err("it is refused at the latest here")
                    .to_string()
            },
        );
        assert!(text.contains("does not speak \"sinew/1\""), "{text}");
        // Dialling such a server
        let mut wire = Wire::new(knee.client(), Arc::new(server));
        let (at_client, _) = wire.run();
        let text = at_client.map_or_else(
            |error| words(&error),
            |()| {
                knee.peer(&wire.client, None, at(NOW))
                    .expect_err("it is refused at the latest here")
                    .to_string()
            },
        );
        assert!(text.contains("does not speak \"sinew/1\""), "{text}");
    }
    assert_eq!(PROTOCOL, b"sinew/1");
}

#[test]
fn certificate_without_project_identity_is_rejected() {
    let walker = Authority::new("walker");
    let knee = walker.tls("knee", 12);
    let both = vec![identity("hip", 11).uri(), identity("knee", 12).uri()];
    let mut other = identity("hip", 11);
    other.project = "runner".to_owned();
    let client_only = vec![ExtendedKeyUsagePurpose::ClientAuth];
    let of = |uris| CertificateContent { uris, ..CertificateContent::of(&identity("hip", 11)) };
    for (content, part) in [
        (of(vec![]), "names no node"),
        (of(both), "names no node"),
        (of(vec!["https://example.org/".to_owned()]), "names no node"),
        (of(vec![other.uri()]), "of project \"runner\""),
        (
            CertificateContent { usages: client_only, ..of(vec![identity("hip", 11).uri()]) },
            "not from this project's authority",
        ),
    ] {
        let server = raw(&walker, &content);
        let text = refusal(Wire::new(knee.client(), server).run().0);
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn host_authorities_admit_no_node() {
    // Given: a certificate in a chain, of an authority that is not the pinned one
    let walker = Authority::new("walker");
    let own = identity("hip", 11);
    let knee = walker.tls("knee", 12);
    let other = Authority::new("walker");
    let pair = other.sign(&CertificateContent::of(&own));
    // When: it shows the authority of the project besides, as if that had signed it
    let directory = Directory::new();
    directory.put(names::NODE_CERTIFICATE, 0o644, &(pair.certificate + &walker.pem));
    directory.put(names::NODE_KEY, 0o600, &pair.key);
    let text = refusal(Wire::new(knee.client(), chained(&directory)).run().0);
    // Then
    assert!(text.contains("more certificates stand between"), "{text}");
}

/// A server that presents the certificates of a directory unchanged.
fn chained(directory: &Directory) -> Arc<ServerConfig> {
    use rustls::pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject};
    let read = |name: &str| std::fs::read(directory.path().join(name)).unwrap();
    let chain = read(names::NODE_CERTIFICATE);
    let chain = CertificateDer::pem_slice_iter(&chain).map(Result::unwrap).collect();
    let key = PrivateKeyDer::from_pem_slice(&read(names::NODE_KEY)).unwrap();
    let mut config = ServerConfig::builder_with_provider(Arc::new(provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(chain, key)
        .unwrap();
    config.alpn_protocols = vec![PROTOCOL.to_vec()];
    Arc::new(config)
}

/// A server with such a certificate.
fn raw(walker: &Authority, content: &CertificateContent) -> Arc<ServerConfig> {
    let directory = walker.directory(content);
    chained(&directory)
}

/// A client that accepts any server, and shows the certificate of `own`, or none.
fn accept_any(like: &Tls, own: Option<&Tls>) -> Arc<ClientConfig> {
    let mut config = ClientConfig::builder_with_provider(Arc::new(provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AcceptAny))
        .with_no_client_auth();
    if let Some(own) = own {
        config.client_auth_cert_resolver = own.client().client_auth_cert_resolver.clone();
    }
    config.alpn_protocols.clone_from(&like.client().alpn_protocols);
    config.resumption = Resumption::disabled();
    Arc::new(config)
}

/// Both ends of a node that supports TLS 1.2 only.
fn of_version_1_2(credentials: &Credentials) -> (Arc<ClientConfig>, Arc<ServerConfig>) {
    let chain = vec![credentials.certificate.der().clone()];
    let client = ClientConfig::builder_with_provider(Arc::new(provider()))
        .with_protocol_versions(&[&TLS12])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AcceptAny))
        .with_client_auth_cert(chain.clone(), credentials.key.clone_key())
        .unwrap();
    let server = ServerConfig::builder_with_provider(Arc::new(provider()))
        .with_protocol_versions(&[&TLS12])
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(chain, credentials.key.clone_key())
        .unwrap();
    (Arc::new(client), Arc::new(server))
}

/// A resolver that shows a certificate and signs with another key.
#[derive(Debug)]
struct MismatchedKey(Arc<rustls::sign::CertifiedKey>);

impl MismatchedKey {
    fn new(stolen: &Credentials) -> Self {
        let key = provider().key_provider.load_private_key(stolen.key.clone_key()).unwrap();
        let chain = vec![stolen.certificate.der().clone()];
        Self(Arc::new(rustls::sign::CertifiedKey::new(chain, key)))
    }
}

impl rustls::client::ResolvesClientCert for MismatchedKey {
    fn resolve(&self, _: &[&[u8]], _: &[rustls::SignatureScheme]) -> Option<Arc<rustls::sign::CertifiedKey>> {
        Some(self.0.clone())
    }

    fn has_certs(&self) -> bool {
        true
    }
}

/// Accepts any peer.
#[derive(Debug)]
pub(super) struct AcceptAny;

mod accept_any {
    use rustls::{
        DigitallySignedStruct, Error, SignatureScheme,
        client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
        pki_types::{CertificateDer, ServerName, UnixTime},
    };

    impl ServerCertVerifier for super::AcceptAny {
        fn verify_server_cert(
            &self,
            _: &CertificateDer<'_>,
            _: &[CertificateDer<'_>],
            _: &ServerName<'_>,
            _: &[u8],
            _: UnixTime,
        ) -> Result<ServerCertVerified, Error> {
            Ok(ServerCertVerified::assertion())
        }

        fn verify_tls12_signature(
            &self,
            _: &[u8],
            _: &CertificateDer<'_>,
            _: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            Ok(HandshakeSignatureValid::assertion())
        }

        fn verify_tls13_signature(
            &self,
            _: &[u8],
            _: &CertificateDer<'_>,
            _: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            Ok(HandshakeSignatureValid::assertion())
        }

        fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
            crate::tls::provider().signature_verification_algorithms.supported_schemes()
        }
    }
}
