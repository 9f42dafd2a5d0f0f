//! Control of a camera, and the features that it describes.

use std::error::Error;
use std::net::{Ipv4Addr, SocketAddr};

use tokio::runtime::{Builder, Runtime};
use tokio::sync::Mutex;
use viva_genapi_xml::{XmlError, fetch_and_load_xml};
use viva_genicam::genapi::NodeMap;
use viva_genicam::gige::{GVCP_PORT, GigeDevice};
use viva_genicam::{Camera, GigeRegisterIo};

use super::description;

/// Longest description that is read, bytes: memory for it is allocated before it has come. Those of
/// cameras have a megabyte, so half of it does the same.
const MOST_DESCRIPTION_BYTES: usize = 64 << 20;

/// A camera under control, which is given back when the camera is dropped.
pub(super) struct ControlledCamera {
    pub(super) camera: Camera<GigeRegisterIo>,
    /// Serves the camera's socket: it must be dropped after the camera.
    pub(super) runtime: Runtime,
}

impl ControlledCamera {
    /// Takes control of the camera at an address, and reads its description.
    ///
    /// # Errors
    /// What was wrong, in words.
    pub(super) fn open(address: Ipv4Addr) -> Result<Self, String> {
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .map_err(|error| error.to_string())?;
        let (device, xml) = runtime.block_on(controlled(address))?;
        // From here on control is given back, whatever is wrong.
        let transport = GigeRegisterIo::new(runtime.handle().clone(), device);
        let xml = xml.map_err(|error| in_words(&error))?;
        description::check(&xml)?;
        let model = viva_genapi_xml::parse(&xml).map_err(|error| in_words(&error))?;
        let features = NodeMap::try_from_xml(model).map_err(|error| in_words(&error))?;
        Ok(Self { camera: Camera::new(transport, features), runtime })
    }
}

/// A camera under control, and its description, if it could be read.
async fn controlled(address: Ipv4Addr) -> Result<(GigeDevice, Result<String, XmlError>), String> {
    let control = SocketAddr::new(address.into(), GVCP_PORT);
    let mut device = GigeDevice::open(control).await.map_err(|error| in_words(&error))?;
    device.claim_control().await.map_err(|error| format!("claim control: {}", in_words(&error)))?;
    // A camera that cannot say that an answer takes longer is asked again.
    let _ = device.enable_pending_ack().await;
    let device = Mutex::new(device);
    let xml = fetch_and_load_xml(|at, length| {
        let device = &device;
        async move {
            if length > MOST_DESCRIPTION_BYTES {
                return Err(XmlError::transport("the description is too long"));
            }
            device.lock().await.read_mem(at, length).await.map_err(XmlError::transport)
        }
    })
    .await;
    Ok((device.into_inner(), xml))
}

/// An error in words for people, with its causes.
pub(super) fn in_words(error: &dyn Error) -> String {
    let mut words = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !words.contains(&text) {
            words = format!("{words}: {text}");
        }
        cause = error.source();
    }
    words
}
