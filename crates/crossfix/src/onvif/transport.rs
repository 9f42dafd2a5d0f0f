//! HTTP requests to a camera, which is trusted as little as possible: redirects are not followed,
//! and its answers must be short and not deeply nested.

use anyhow::Context;
use async_trait::async_trait;
use crossfix_video::Login;
use diqwest::{DigestAuthSession, WithDigestAuth};
use oxvif::transport::{Transport, TransportError};
use reqwest::redirect::Policy;
use reqwest::{Client, Response};

/// Longest answer of a camera that is read, bytes: the most talkative camera's profiles are a fifth
/// of it. With half of it some would be refused; without a bound a camera could fill the memory.
const LONGEST: usize = 256 << 10;
/// Deepest nesting of an answer: ONVIF's own is about fifteen. The parser uses some stack for each
/// level. With half of it the same.
const DEEPEST: usize = 64;

/// HTTP to a camera.
pub struct ToCamera {
    client: Client,
    digest: Option<DigestAuthSession>,
}

impl ToCamera {
    /// A client with a login, or without one.
    ///
    /// # Errors
    /// If this host has no certificates of authorities.
    pub fn new(login: Option<&Login>) -> anyhow::Result<Self> {
        // Every request carries the login's proof, which no other host may see: no redirects.
        let client = Client::builder().redirect(Policy::none()).build();
        let client =
            client.context("nobody can be asked by HTTP: are ca-certificates installed?")?;
        let digest = login.map(|login| DigestAuthSession::new(login.user(), login.password()));
        Ok(Self { client, digest })
    }
}

#[async_trait]
impl Transport for ToCamera {
    async fn soap_post(
        &self,
        url: &str,
        action: &str,
        body: String,
    ) -> Result<String, TransportError> {
        let content = format!("application/soap+xml; charset=utf-8; action=\"{action}\"");
        let request = self.client.post(url).header("Content-Type", content).body(body);
        let answer = match &self.digest {
            None => request.send().await?,
            Some(digest) => {
                request.send_digest_auth(digest).await.map_err(|error| match error {
                    diqwest::error::Error::Reqwest(error) => TransportError::Http(error),
                    other => TransportError::HttpStatus { status: 401, body: other.to_string() },
                })?
            }
        };
        let status = answer.status().as_u16();
        let refused = |body: String| TransportError::HttpStatus { status, body };
        let text =
            read(answer).await?.ok_or_else(|| refused("its answer is too long".to_owned()))?;
        if depth(&text) > DEEPEST {
            return Err(refused("its answer is too deep".to_owned()));
        }
        // Answers with a fault say why.
        if matches!(status, 200 | 400 | 500) { Ok(text) } else { Err(refused(text)) }
    }
}

/// The text of an answer, if it is no longer than allowed.
async fn read(mut answer: Response) -> Result<Option<String>, TransportError> {
    let mut bytes = Vec::new();
    while let Some(chunk) = answer.chunk().await? {
        if bytes.len() + chunk.len() > LONGEST {
            return Ok(None);
        }
        bytes.extend_from_slice(&chunk);
    }
    Ok(Some(String::from_utf8_lossy(&bytes).into_owned()))
}

/// How deeply elements are nested.
fn depth(text: &str) -> usize {
    let (mut open, mut deepest) = (0_usize, 0);
    let mut rest = text;
    while let Some(begin) = rest.find('<') {
        rest = &rest[begin..];
        // Text inside these is not an element, whatever it looks like.
        let aside = [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>"), ("<!", ">"), ("</", ">")];
        if let Some((begin, end)) = aside.iter().find(|(begin, _)| rest.starts_with(begin)) {
            open = open.saturating_sub(usize::from(*begin == "</"));
            let inside = &rest[begin.len()..];
            rest = inside.find(end).map_or("", |at| &inside[at + end.len()..]);
            continue;
        }
        let end = end_of_tag(rest);
        if !rest[..end].ends_with('/') {
            open += 1;
            deepest = deepest.max(open);
        }
        rest = &rest[end..];
    }
    deepest
}

/// Where the tag that begins here ends: at a `>` outside quotes.
fn end_of_tag(text: &str) -> usize {
    let mut quote = None;
    for (at, letter) in text.char_indices() {
        match (quote, letter) {
            (None, '>') => return at,
            (None, '"' | '\'') => quote = Some(letter),
            (Some(begun), _) if begun == letter => quote = None,
            _ => {}
        }
    }
    text.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn elements_within_one_another_are_counted() {
        assert_eq!(depth("<?xml version='1.0'?><a><b/><c x='1'><d>t</d></c><!-- <z> --></a>"), 3);
        assert_eq!(depth(&"<a>".repeat(1000)), 1000);
        assert_eq!(depth("no element"), 0);
        // What only looks like an end tag is none.
        for hides in
            ["<b x=\"/>/></a></a>\"/>", "<!-- </a></a> -->", "<![CDATA[</a></a>]]>", "<?x </a> ?>"]
        {
            assert_eq!(depth(&format!("<a>{hides}").repeat(100)), 100, "{hides}");
        }
    }
}
