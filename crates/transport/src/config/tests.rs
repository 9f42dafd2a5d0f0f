use super::*;

fn network() -> NetworkConfig {
    NetworkConfig {
        site: "field".parse().unwrap(),
        mode: Mode::Peer,
        routers: vec![],
        unsecured: false,
        security: None,
        anchor: None,
        fusion: Some("tcp/127.0.0.1:7450".into()),
        areas: BTreeMap::new(),
        cameras: [("a", 7451), ("b", 7452)]
            .map(|(name, port)| (name.parse().unwrap(), format!("tcp/127.0.0.1:{port}")))
            .into(),
    }
}

#[test]
fn every_pair_has_exactly_one_side_that_connects() {
    let network = network();
    let (listen, connect) = network.endpoints(&Role::Fusion(None)).unwrap();
    assert_eq!((listen.len(), connect.len()), (1, 2));
    let (listen, connect) = network.endpoints(&Role::Observer).unwrap();
    assert_eq!((listen.len(), connect.len()), (0, 3));
    let unknown = Role::Camera("c".parse().unwrap());
    assert!(matches!(network.endpoints(&unknown), Err(NetworkError::UnknownCamera(_))));
}

#[test]
fn who_listens_for_other_hosts_has_certificates_or_was_told_to_do_without() {
    let there = |network: &NetworkConfig| network.endpoints(&Role::Fusion(None)).map(|(l, _)| l);
    let open = NetworkConfig { fusion: Some("tcp/10.0.0.1:7450".into()), ..network() };
    assert_eq!(there(&open), Err(NetworkError::Unsecured("tcp/10.0.0.1:7450".into())));
    assert!(open.endpoints(&Role::Observer).is_ok(), "who looks on listens nowhere");
    let told = NetworkConfig { unsecured: true, ..open.clone() };
    assert_eq!(there(&told), Ok(vec!["tcp/10.0.0.1:7450".to_owned()]));
    let security = Security { certificates: "c".into(), revoked: BTreeMap::new() };
    let secured = NetworkConfig { security: Some(security), ..open };
    assert_eq!(there(&secured), Ok(vec!["tls/10.0.0.1:7450".to_owned()]));
}

#[test]
fn impossible_endpoints_are_named() {
    let mut bad = network();
    bad.fusion = Some("127.0.0.1:7450".into());
    assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { of, .. }) if of == "fusion"));
    for endpoint in [
        "tcp/:7451",
        "tcp/a/b:7451",
        "tcp/a:1#iface=x;x=:2",
        "udp/127.0.0.1:7451",
        "tcp/127.0.0.1:99999",
    ] {
        let bad = NetworkConfig { fusion: Some(endpoint.into()), ..network() };
        assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { .. })), "{endpoint}");
        let bad = NetworkConfig { routers: vec![endpoint.into()], ..network() };
        assert!(matches!(bad.validate(), Err(NetworkError::Endpoint { .. })), "{endpoint}");
    }
    let mut shared = network();
    shared.fusion = Some("tcp/127.0.0.1:7451".into());
    assert!(matches!(shared.validate(), Err(NetworkError::Shared { .. })));
}

/// Cameras `a` to `d` in three areas: west and middle share `b`, middle and east `c`.
fn divided() -> NetworkConfig {
    let area = |port: u16, cameras: [&str; 2]| Area {
        fusion: format!("tcp/127.0.0.1:{port}"),
        cameras: cameras.map(|name| name.parse().unwrap()).into(),
    };
    let mut divided = network();
    divided.fusion = None;
    for (name, port) in [("c", 7453), ("d", 7454)] {
        divided.cameras.insert(name.parse().unwrap(), format!("tcp/127.0.0.1:{port}"));
    }
    let areas =
        [("west", 7461, ["a", "b"]), ("middle", 7462, ["b", "c"]), ("east", 7463, ["c", "d"])];
    divided.areas =
        areas.map(|(name, port, cameras)| (name.parse().unwrap(), area(port, cameras))).into();
    divided
}

#[test]
fn areas_that_share_a_camera_are_linked_once_and_others_are_not() {
    let network = divided();
    network.validate().unwrap();
    let connects = |area: &str| {
        let role = Role::Fusion(Some(area.parse().unwrap()));
        let (listen, connect) = network.endpoints(&role).unwrap();
        (listen, connect.iter().map(|e| e[e.len() - 4..].to_owned()).collect::<Vec<_>>())
    };
    // By name, east comes before middle, and west is last.
    assert_eq!(connects("east").1, ["7453", "7454"]);
    assert_eq!(connects("middle").1, ["7452", "7453", "7463"]);
    assert_eq!(connects("west").1, ["7451", "7452", "7462"]);
    assert_eq!(connects("west").0, ["tcp/127.0.0.1:7461"]);
    let (_, all) = network.endpoints(&Role::Observer).unwrap();
    assert_eq!(all.len(), 7, "who looks on hears every camera and every centre");
    assert_eq!(network.areas_of(&"b".parse().unwrap()).len(), 2);
}

#[test]
fn impossible_areas_are_named() {
    let refused = |change: fn(&mut NetworkConfig)| {
        let mut network = divided();
        change(&mut network);
        network.validate().unwrap_err()
    };
    let both = refused(|network| network.fusion = Some("tcp/127.0.0.1:7460".to_owned()));
    assert_eq!(both, NetworkError::Centres);
    assert_eq!(refused(|network| network.areas.clear()), NetworkError::Centres);
    let unheard = refused(|network| {
        let _ = network.areas.remove(&"east".parse::<AreaName>().unwrap());
    });
    assert_eq!(unheard, NetworkError::CameraOfNoArea("d".parse().unwrap()));
    let unknown = refused(|network| {
        let _ = network.cameras.remove(&"a".parse::<CameraName>().unwrap());
    });
    assert!(matches!(unknown, NetworkError::CameraOfArea { .. }), "{unknown}");
    for cameras in [vec!["a"], vec!["a", "a", "b"], vec![]] {
        let mut network = divided();
        let west = network.areas.get_mut(&"west".parse::<AreaName>().unwrap()).unwrap();
        west.cameras = cameras.into_iter().map(|name| name.parse().unwrap()).collect();
        let error = network.validate().unwrap_err();
        assert!(matches!(error, NetworkError::CamerasOfArea(_)), "{error}");
    }
    let nowhere = Role::Fusion(Some("north".parse().unwrap()));
    assert!(matches!(divided().endpoints(&nowhere), Err(NetworkError::UnknownArea(_))));
    assert_eq!(divided().endpoints(&Role::Fusion(None)), Err(NetworkError::WhichArea));
}
