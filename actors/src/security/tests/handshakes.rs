//! Who gets in, who does not, and what each end is told.

use std::sync::Arc;

use rcgen::ExtendedKeyUsagePurpose;
use rustls::{ClientConfig, ServerConfig, client::Resumption, version::TLS12};

use super::ground::{Authority, Clock, DAY, Directory, NOW, Wire, Wish, at, identity, is_open, load, tls};
use crate::security::{
    Credentials, Judged, PROTOCOL, PeerFault, TimeFault, TimePolicy, Tls, files as names, tls::provider,
    words,
};

/// The hip dials the knee.
fn between(hip: &Tls, knee: &Tls) -> Wire {
    Wire::new(hip.client(), knee.server())
}

/// What an end says of the other one that it did not take, as itself and in words.
fn refusal(result: Result<(), rustls::Error>) -> String {
    words(&result.expect_err("the other end is not taken"))
}

#[test]
fn two_nodes_of_a_project_know_each_other() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = between(&hip, &knee);
    // Before it is over nobody is there.
    assert_eq!(knee.peer(&wire.server, None, at(NOW)), Err(PeerFault::Unfinished));
    // When
    assert_eq!(wire.run(), (Ok(()), Ok(())));
    // Then: each knows who is there
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
fn a_node_of_another_project_gets_in_nowhere() {
    // Given: projects of one name, each with an authority of its own, as two laboratories may have
    let (hip, knee) = (Authority::new("walker").tls("hip", 11), Authority::new("walker").tls("knee", 12));
    // When
    let (at_client, _) = between(&hip, &knee).run();
    // Then: the dialling end says so
    let said = refusal(at_client);
    assert!(said.contains("not from this project's authority"), "{said}");
    // And: one that does not care whom it dials is refused by the other
    let mut wire = Wire::new(careless(&hip, Some(&hip)), knee.server());
    let (at_client, at_server) = wire.run();
    let said = refusal(at_server);
    assert!(
        said.contains("not from this project's authority") && said.contains("sinew keys issue"),
        "{said}"
    );
    let said = refusal(at_client);
    assert!(said.contains("does not take this node's certificate; its log says why"), "{said}");
    assert!(knee.peer(&wire.server, None, at(NOW)).is_err());
}

#[test]
fn who_shows_no_certificate_does_not_get_in() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = Wire::new(careless(&hip, None), knee.server());
    let (at_client, at_server) = wire.run();
    let said = refusal(at_server);
    assert!(said.contains("shows no certificate") && said.contains("sinew keys issue"), "{said}");
    let said = refusal(at_client);
    assert!(said.contains("got no certificate from here"), "{said}");
    assert!(!is_open(&wire.server) && knee.peer(&wire.server, None, at(NOW)).is_err());
}

#[test]
fn a_certificate_without_its_key_does_not_get_in() {
    // Given: the certificate of the hip, which everybody on the network can see, with another key
    let walker = Authority::new("walker");
    let knee = walker.tls("knee", 12);
    let mut stolen = walker.credentials("hip", 11);
    stolen.key = walker.credentials("ankle", 13).key;
    // Then: rustls itself takes them for no pair
    assert!(Tls::new(&stolen, Arc::new(Clock(NOW))).is_err());
    // And: whoever signs with the other key all the same is refused
    let resolver = MixedUp::new(&stolen);
    let mut client = (*careless(&knee, None)).clone();
    client.client_auth_cert_resolver = Arc::new(resolver);
    let (_, at_server) = Wire::new(Arc::new(client), knee.server()).run();
    let said = refusal(at_server);
    assert!(said.contains("does not hold the key"), "{said}");
}

#[test]
fn the_stolen_keys_of_one_node_do_not_make_another() {
    // Given: somebody who has the ankle's keys, and says that he is the knee
    let walker = Authority::new("walker");
    let (hip, ankle) = (walker.tls("hip", 11), walker.tls("ankle", 13));
    let mut wire = between(&hip, &ankle);
    assert_eq!(wire.run(), (Ok(()), Ok(())));
    // When: the hip wants the knee
    let fault = hip.peer(&wire.client, Some([192, 168, 0, 12].into()), at(NOW)).unwrap_err();
    // Then
    let expected =
        PeerFault::SomebodyElse { identity: identity("ankle", 13), expected: [192, 168, 0, 12].into() };
    assert_eq!(fault, expected);
    let said = fault.to_string();
    assert!(said.contains("192.168.0.13") && said.contains("where 192.168.0.12 was to be"), "{said}");
}

#[test]
fn a_revoked_certificate_gets_in_at_neither_end() {
    let walker = Authority::new("walker");
    let ankle = walker.credentials("ankle", 13);
    let own = identity("hip", 11);
    let directory = walker.directory(&Wish::of(&own));
    directory.put(names::DENIED, 0o644, &format!("{}  # ankle\n", ankle.serial()));
    let (hip, ankle) = (tls(&load(&directory, &own)), tls(&ankle));
    let (at_client, _) = between(&hip, &ankle).run();
    let (_, at_server) = between(&ankle, &hip).run();
    for said in [refusal(at_client), refusal(at_server)] {
        assert!(said.contains("\"ankle\" (192.168.0.13)") && said.contains("is revoked"), "{said}");
    }
    // And: others of the same authority are not
    assert_eq!(between(&hip, &walker.tls("knee", 12)).run(), (Ok(()), Ok(())));
}

/// A node whose certificate counts from `from` to `until`, under a policy, with a clock.
fn timed(walker: &Authority, name: &str, [from, until]: [u64; 2], policy: TimePolicy, now: u64) -> Tls {
    let own = identity(name, 20);
    let directory = walker.directory(&Wish { from, until, ..Wish::of(&own) });
    let mut credentials = Credentials::load(directory.path(), &own, TimePolicy::Ignored, at(now)).unwrap();
    credentials.believed.policy = policy;
    Tls::new(&credentials, Arc::new(Clock(now))).unwrap()
}

const USUAL: [u64; 2] = [NOW - DAY, NOW + DAY];

#[test]
fn a_certificate_that_has_ended_or_is_to_come_gets_in_at_neither_end() {
    let walker = Authority::new("walker");
    let hip = walker.tls("hip", 11);
    for (times, part) in [
        ([NOW - 2 * DAY, NOW - 1], "it ended on 2026-11-22T"),
        ([NOW + 3_600, NOW + DAY], "it counts from 2026-11-22T"),
    ] {
        let other = timed(&walker, "old", times, TimePolicy::Ignored, NOW);
        let (at_client, _) = between(&hip, &other).run();
        let (_, at_server) = between(&other, &hip).run();
        for said in [refusal(at_client), refusal(at_server)] {
            assert!(said.contains("\"old\" (192.168.0.20)") && said.contains(part), "{said}");
        }
        // And: it ends in the middle of a connection
        let (mut wire, open) = (between(&hip, &walker.tls("knee", 12)), at(NOW + 366 * DAY));
        assert_eq!(wire.run(), (Ok(()), Ok(())));
        let fault = hip.peer(&wire.client, None, open).unwrap_err();
        assert!(matches!(fault, PeerFault::Times { why: TimeFault::Over { .. }, .. }), "{fault}");
    }
}

#[test]
fn a_clock_in_1970_is_met_as_the_policy_says_and_told() {
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
            let said = refusal(at_client);
            assert!(said.contains("1970-01-01T00:00:12Z") && said.contains("the clock is not set"), "{said}");
            continue;
        };
        assert_eq!(at_client, Ok(()), "{policy:?}");
        let peer = robot.peer(&wire.client, None, at(12)).unwrap();
        assert_eq!(peer.times, times);
        assert!(peer.warning().is_some_and(|words| words.contains("\"knee\"")), "it is said");
    }
    // And: who had ended when the robot's own certificate was made is refused in 1970, too
    let robot = timed(&walker, "robot", USUAL, TimePolicy::UntilSet, 12);
    let gone = timed(&walker, "gone", [NOW - 3 * DAY, NOW - 2 * DAY], TimePolicy::Ignored, NOW);
    let said = refusal(between(&robot, &gone).run().0);
    assert!(said.contains("it ended on 2026-11-20"), "{said}");
}

#[test]
fn tls_1_2_is_not_spoken_at_either_end() {
    let walker = Authority::new("walker");
    let hip = walker.tls("hip", 11);
    let (client, server) = of_version_1_2(&walker.credentials("knee", 12));
    let (at_client, at_server) = Wire::new(client, hip.server()).run();
    for said in [refusal(at_server), refusal(at_client)] {
        assert!(said.contains("does not speak TLS 1.3"), "{said}");
    }
    let (at_client, at_server) = Wire::new(hip.client(), server).run();
    assert!(at_server.is_err());
    let said = refusal(at_client);
    assert!(said.contains("does not speak TLS 1.3"), "{said}");
}

#[test]
fn another_protocol_inside_is_refused_and_so_is_none() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    for protocols in [vec![], vec![b"sinew/2".to_vec()], vec![b"http/1.1".to_vec()]] {
        let (mut client, mut server) = ((*hip.client()).clone(), (*hip.server()).clone());
        client.alpn_protocols.clone_from(&protocols);
        server.alpn_protocols.clone_from(&protocols);
        // Dialled by such a one
        let mut wire = Wire::new(Arc::new(client), knee.server());
        let (_, at_server) = wire.run();
        let said = at_server.map_or_else(
            |error| words(&error),
            |()| {
                knee.peer(&wire.server, None, at(NOW))
                    .expect_err("it is refused at the latest here")
                    .to_string()
            },
        );
        assert!(said.contains("does not speak \"sinew/1\""), "{said}");
        // Dialling such a one
        let mut wire = Wire::new(knee.client(), Arc::new(server));
        let (at_client, _) = wire.run();
        let said = at_client.map_or_else(
            |error| words(&error),
            |()| {
                knee.peer(&wire.client, None, at(NOW))
                    .expect_err("it is refused at the latest here")
                    .to_string()
            },
        );
        assert!(said.contains("does not speak \"sinew/1\""), "{said}");
    }
    assert_eq!(PROTOCOL, b"sinew/1");
}

#[test]
fn a_certificate_that_names_no_node_of_the_project_does_not_get_in() {
    let walker = Authority::new("walker");
    let knee = walker.tls("knee", 12);
    let both = vec![identity("hip", 11).uri(), identity("knee", 12).uri()];
    let mut other = identity("hip", 11);
    other.project = "runner".to_owned();
    let client_only = vec![ExtendedKeyUsagePurpose::ClientAuth];
    let of = |uris| Wish { uris, ..Wish::of(&identity("hip", 11)) };
    for (wish, part) in [
        (of(vec![]), "names no node"),
        (of(both), "names no node"),
        (of(vec!["https://example.org/".to_owned()]), "names no node"),
        (of(vec![other.uri()]), "of project \"runner\""),
        (
            Wish { usages: client_only, ..of(vec![identity("hip", 11).uri()]) },
            "not from this project's authority",
        ),
    ] {
        let server = raw(&walker, &wish);
        let said = refusal(Wire::new(knee.client(), server).run().0);
        assert!(said.contains(part), "{said}");
    }
}

#[test]
fn an_authority_of_the_hosts_system_lets_nobody_in() {
    // Given: a certificate in a chain, of an authority that is not the pinned one
    let walker = Authority::new("walker");
    let own = identity("hip", 11);
    let knee = walker.tls("knee", 12);
    let other = Authority::new("walker");
    let pair = other.sign(&Wish::of(&own));
    // When: it shows the authority of the project besides, as if that had signed it
    let directory = Directory::new();
    directory.put(names::NODE_CERTIFICATE, 0o644, &(pair.certificate + &walker.pem));
    directory.put(names::NODE_KEY, 0o600, &pair.key);
    let said = refusal(Wire::new(knee.client(), chained(&directory)).run().0);
    // Then
    assert!(said.contains("more certificates stand between"), "{said}");
}

/// A server that shows what is in a directory, as it is.
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
fn raw(walker: &Authority, wish: &Wish) -> Arc<ServerConfig> {
    let directory = walker.directory(wish);
    chained(&directory)
}

/// A client that takes anybody, and shows the certificate of `own`, or none.
fn careless(like: &Tls, own: Option<&Tls>) -> Arc<ClientConfig> {
    let mut config = ClientConfig::builder_with_provider(Arc::new(provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(Careless))
        .with_no_client_auth();
    if let Some(own) = own {
        config.client_auth_cert_resolver = own.client().client_auth_cert_resolver.clone();
    }
    config.alpn_protocols.clone_from(&like.client().alpn_protocols);
    config.resumption = Resumption::disabled();
    Arc::new(config)
}

/// Both ends of a node that speaks TLS 1.2 only.
fn of_version_1_2(credentials: &Credentials) -> (Arc<ClientConfig>, Arc<ServerConfig>) {
    let chain = vec![credentials.certificate.der().clone()];
    let client = ClientConfig::builder_with_provider(Arc::new(provider()))
        .with_protocol_versions(&[&TLS12])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(Careless))
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

/// Somebody who shows a certificate and signs with another key.
#[derive(Debug)]
struct MixedUp(Arc<rustls::sign::CertifiedKey>);

impl MixedUp {
    fn new(stolen: &Credentials) -> Self {
        let key = provider().key_provider.load_private_key(stolen.key.clone_key()).unwrap();
        let chain = vec![stolen.certificate.der().clone()];
        Self(Arc::new(rustls::sign::CertifiedKey::new(chain, key)))
    }
}

impl rustls::client::ResolvesClientCert for MixedUp {
    fn resolve(&self, _: &[&[u8]], _: &[rustls::SignatureScheme]) -> Option<Arc<rustls::sign::CertifiedKey>> {
        Some(self.0.clone())
    }

    fn has_certs(&self) -> bool {
        true
    }
}

/// Takes everybody.
#[derive(Debug)]
pub(super) struct Careless;

mod careless {
    use rustls::{
        DigitallySignedStruct, Error, SignatureScheme,
        client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier},
        pki_types::{CertificateDer, ServerName, UnixTime},
    };

    impl ServerCertVerifier for super::Careless {
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
            crate::security::tls::provider().signature_verification_algorithms.supported_schemes()
        }
    }
}
