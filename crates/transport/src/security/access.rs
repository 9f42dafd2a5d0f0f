//! Which component may publish what: one table for all, in the form of Zenoh's access control.

use std::iter::once;

use crossfix_message::{Key, SiteName};
use serde_json::{Value, json};

use super::{Identity, Security};
use crate::NetworkConfig;

/// Kinds of messages that publish.
const SAYING: [&str; 3] = ["put", "delete", "liveliness_token"];
/// Kinds of messages that subscribe or query.
const ASKING: [&str; 4] =
    ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"];
/// The kind of message that answers a query.
const ANSWERING: &str = "reply";

/// What the holder of one certificate may do in a session with the reader of these rules.
struct Rights {
    identity: Identity,
    /// Key expressions that it may publish on.
    says: Vec<String>,
    /// Key expressions that it may receive.
    hears: Vec<String>,
}

impl Rights {
    fn of(identity: Identity, site: &SiteName) -> Self {
        let of = |component: &str| format!("crossfix/{site}/{component}/**");
        let everything = || vec![format!("crossfix/{site}/**")];
        let (says, hears) = match &identity {
            // An agent starts once its receivers are alive, so it must hear who is.
            Identity::Camera(camera) => {
                (vec![of(camera.as_str())], vec![of("fusion"), Key::of_all_cameras(site, "alive")])
            }
            Identity::Fusion(None) => (vec![of("fusion")], everything()),
            Identity::Fusion(Some(area)) => (vec![of(&format!("fusion/{area}"))], everything()),
            Identity::Recorder => (vec![of("recorder")], everything()),
            Identity::Viewer => (vec![], everything()),
            Identity::Router => (everything(), everything()),
        };
        Self { identity, says, hears }
    }

    /// A Zenoh rule: allows some kinds of messages on some keys in one direction; `None` without
    /// keys.
    fn rule(&self, what: &str, flow: &str, messages: &[&str], keys: &[String]) -> Option<Value> {
        (!keys.is_empty()).then(|| {
            json!({
                "id": format!("{} {what}", self.identity), "permission": "allow", "flows": [flow],
                "messages": messages, "key_exprs": keys,
            })
        })
    }

    fn rules(&self, site: &SiteName) -> Vec<Value> {
        let saying: Vec<&str> = SAYING.into_iter().chain(once(ANSWERING)).collect();
        // A component publishes only once it knows of a subscriber. Who subscribes to what is no
        // secret, so subscriptions may go out to all.
        let everything = [format!("crossfix/{site}/**")];
        [
            self.rule("says", "ingress", &saying, &self.says),
            self.rule("asks", "ingress", &ASKING, &self.hears),
            self.rule("hears", "egress", &saying, &self.hears),
            self.rule("is asked", "egress", &ASKING, &everything),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// Zenoh's access control: what this component accepts from each other component, and sends to it.
/// The table is the same for all, as no component is trusted with more by one than by another; what
/// no rule allows is dropped.
///
/// A key expression is allowed only if a rule's includes all of it: `crossfix/site/north/**` does
/// not let an agent subscribe to `crossfix/site/**`.
pub(crate) fn access_control(security: &Security, network: &NetworkConfig) -> Value {
    let site = &network.site;
    let cameras = network.cameras.keys().cloned().map(Identity::Camera);
    let centres = network.centres().map(|(area, _)| Identity::Fusion(area));
    let others = [Identity::Recorder, Identity::Router, Identity::Viewer];
    let everybody = cameras.chain(centres).chain(others);
    let (mut rules, mut subjects, mut policies) = (Vec::new(), Vec::new(), Vec::new());
    for rights in everybody.map(|identity| Rights::of(identity, site)) {
        let id = rights.identity.to_string();
        let common_name = security.common_name(&rights.identity);
        subjects.push(json!({ "id": id, "cert_common_names": [common_name] }));
        let allowed = rights.rules(site);
        let names: Vec<&Value> = allowed.iter().map(|rule| &rule["id"]).collect();
        policies.push(json!({ "rules": names, "subjects": [id] }));
        rules.extend(allowed);
    }
    json!({
        "enabled": true, "default_permission": "deny",
        "rules": rules, "subjects": subjects, "policies": policies,
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn the_fusion_centre_of_an_area_speaks_for_its_own_alone() {
        let area =
            |port: u16| json!({ "fusion": format!("tcp/127.0.0.1:{port}"), "cameras": ["a"] });
        let network = json!({
            "site": "field", "cameras": { "a": "tcp/127.0.0.1:1" },
            "areas": { "west": area(2), "east": area(3) },
        });
        let network: NetworkConfig = serde_json::from_value(network).unwrap();
        let security = Security { certificates: "c".into(), revoked: BTreeMap::new() };
        let access = access_control(&security, &network);
        let says = |who: &str| -> Vec<String> {
            let rules = access["rules"].as_array().unwrap().iter();
            let of_who = rules.filter(|rule| rule["id"] == format!("{who} says"));
            let keys = of_who.flat_map(|rule| rule["key_exprs"].as_array().unwrap());
            keys.map(|key| key.as_str().unwrap().to_owned()).collect()
        };
        assert_eq!(says("fusion-west"), ["crossfix/field/fusion/west/**"]);
        assert_eq!(says("fusion-east"), ["crossfix/field/fusion/east/**"]);
        assert!(says("fusion").is_empty(), "there is none for all");
        assert_eq!(says("camera-a"), ["crossfix/field/a/**"]);
    }
}
