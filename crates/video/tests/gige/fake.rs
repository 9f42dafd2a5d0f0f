//! A GigE Vision camera in this process, for tests: control (GVCP), an XML of what it has, and
//! images (GVSP), as far as somebody who watches it uses them (GigE Vision 2.0, 11 to 24).

use std::collections::{BTreeMap, HashMap};
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

/// Where the description of what it has is read, and the registers that it names.
const XML_AT: u32 = 0x0010_0000;
const WIDTH: u32 = 0x2_0000;
const HEIGHT: u32 = 0x2_0004;
const FORMAT: u32 = 0x2_0008;
const START: u32 = 0x2_000c;
const STOP: u32 = 0x2_0010;
const RATE: u32 = 0x2_0014;
const MODE: u32 = 0x2_0018;
const PTP: u32 = 0x2_001c;

/// Blocks whose packets it can send once more.
const REMEMBERED: u16 = 8;

/// A camera's own clock.
#[derive(Clone, Copy)]
pub struct Clock {
    /// Ticks at the start.
    pub begins: u64,
    /// Ticks a second, as it says.
    pub ticks_hz: u64,
    /// How much faster it really runs, millionths.
    pub fast_ppm: f64,
}

/// What the camera does, and does wrong.
pub struct Behaviour {
    pub clock: Clock,
    /// Whether a packet (0 is the leader) of a block is lost on its way when it is sent first.
    pub drops: Box<dyn Fn(u64, u32) -> bool + Send>,
    /// The picture of so many columns and rows at a time by its clock, s.
    pub picture: Box<dyn Fn(f64, usize, usize) -> Vec<u8> + Send>,
    /// Whether it sends packets once more that are asked for.
    pub resends: bool,
    /// Its clock follows another by PTP.
    pub follows: bool,
    /// Another application has control.
    pub taken: bool,
    /// Makes another description of what it has, of the right one.
    pub describes: fn(String) -> String,
}
/// What it knows.
struct State {
    regs: BTreeMap<u32, u32>,
    xml: Vec<u8>,
    url: Vec<u8>,
    controller: Option<SocketAddr>,
    heard: Instant,
    sent: HashMap<(u16, u32), Vec<u8>>,
    behaviour: Behaviour,
    begun: Instant,
}
/// A camera at port 3956 of an address, on threads of its own until it is dropped.
pub struct Fake {
    pub ip: Ipv4Addr,
    state: Arc<Mutex<State>>,
    /// It neither answers nor sends.
    pub mute: Arc<AtomicBool>,
    end: Arc<AtomicBool>,
    threads: Vec<std::thread::JoinHandle<()>>,
    /// When its clock showed what it begins with.
    pub begun: SystemTime,
}

impl State {
    fn ticks(&self) -> u64 {
        let Clock { begins, ticks_hz, fast_ppm } = self.behaviour.clock;
        let passed_s = self.begun.elapsed().as_secs_f64() * (1.0 + fast_ppm * 1e-6);
        begins + (passed_s * ticks_hz as f64) as u64
    }
    fn reg(&self, at: u32) -> u32 {
        self.regs.get(&at).copied().unwrap_or(0)
    }
    fn bytes(&self, at: u32, n: usize) -> Vec<u8> {
        (at..at + n as u32)
            .map(|a| match a {
                0x200..0x400 => self.url.get((a - 0x200) as usize).copied().unwrap_or(0),
                XML_AT.. => self.xml.get((a - XML_AT) as usize).copied().unwrap_or(0),
                _ => self.reg(a & !3).to_be_bytes()[(a & 3) as usize],
            })
            .collect()
    }
    fn write(&mut self, at: u32, value: u32, by: SocketAddr) -> u16 {
        if self.behaviour.taken
            || self.controller.is_some_and(|c| c != by)
            || (at != 0xa00 && self.controller.is_none())
        {
            return 0x8006;
        }
        match at {
            0xa00 => {
                self.controller = (value & 3 != 0).then_some(by);
                self.heard = Instant::now();
            }
            0x944 if value & 2 != 0 => {
                let t = self.ticks();
                self.regs.insert(0x948, (t >> 32) as u32);
                self.regs.insert(0x94c, t as u32);
            }
            0xd04 if value >> 31 != 0 => {} // test packets: none sent, so the size stays
            _ => {}
        }
        let value = if at == 0xd04 { value & 0xffff } else { value };
        self.regs.insert(at, value);
        if at == STOP {
            self.regs.insert(START, 0);
        }
        0
    }
}

impl Fake {
    pub fn start(ip: Ipv4Addr, behaviour: Behaviour) -> Self {
        let xml = (behaviour.describes)(xml());
        let hz = behaviour.clock.ticks_hz;
        let url = format!("Local:fake.xml;{XML_AT:X};{:X}", xml.len()).into_bytes();
        let begun = SystemTime::now();
        let regs = BTreeMap::from([
            (0x904, 1),
            (0x934, if behaviour.resends { 4 } else { 0 }),
            (0x938, 3000),
            (0x93c, (hz >> 32) as u32),
            (0x940, hz as u32),
            (0xd04, 1400),
            (PTP, u32::from(behaviour.follows)),
            (WIDTH, 320),
            (HEIGHT, 240),
            (FORMAT, 0x0108_0001),
            (RATE, 25f32.to_bits()),
        ]);
        let state = Arc::new(Mutex::new(State {
            regs,
            xml: xml.into_bytes(),
            url,
            controller: None,
            heard: Instant::now(),
            sent: HashMap::new(),
            behaviour,
            begun: Instant::now(),
        }));
        let control = UdpSocket::bind((ip, 3956)).unwrap();
        control.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let images = UdpSocket::bind((ip, 0)).unwrap();
        let (mute, end) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
        let again = images.try_clone().unwrap();
        let (s, m, e) = (state.clone(), mute.clone(), end.clone());
        let a = std::thread::spawn(move || {
            while !e.load(SeqCst) {
                serve(&control, &again, &s, &m, ip);
            }
        });
        let (s, m, e) = (state.clone(), mute.clone(), end.clone());
        let b = std::thread::spawn(move || {
            let mut block = 0;
            while !e.load(SeqCst) {
                send(&images, &s, &m, &mut block);
            }
        });
        Self { ip, state, mute, end, threads: vec![a, b], begun }
    }
    pub fn is_controlled(&self) -> bool {
        self.state.lock().unwrap().controller.is_some()
    }
    pub fn is_acquiring(&self) -> bool {
        self.state.lock().unwrap().reg(START) == 1
    }
}
impl Drop for Fake {
    fn drop(&mut self) {
        self.end.store(true, SeqCst);
        for t in self.threads.drain(..) {
            let _ = t.join();
        }
    }
}

fn u16_at(b: &[u8], i: usize) -> u16 {
    u16::from_be_bytes(b[i..i + 2].try_into().unwrap())
}
fn u32_at(b: &[u8], i: usize) -> u32 {
    u32::from_be_bytes(b[i..i + 4].try_into().unwrap())
}

fn serve(
    control: &UdpSocket,
    images: &UdpSocket,
    state: &Mutex<State>,
    mute: &AtomicBool,
    ip: Ipv4Addr,
) {
    let mut b = [0; 2048];
    let got = control.recv_from(&mut b);
    let mut s = state.lock().unwrap();
    if s.controller.is_some() && s.heard.elapsed() > Duration::from_secs(3) {
        s.controller = None;
        s.regs.insert(0xa00, 0);
        s.regs.insert(START, 0);
    }
    let Ok((n, from)) = got else { return };
    if mute.load(SeqCst) || n < 8 || b[0] != 0x42 {
        return;
    }
    if s.controller == Some(from) {
        s.heard = Instant::now();
    }
    let (command, id, p) = (u16_at(&b, 2), u16_at(&b, 6), &b[8..n]);
    let (mut status, mut answer) = (0u16, Vec::new());
    match command {
        2 => {
            answer = vec![0; 248];
            answer[1] = 2;
            answer[10..16].copy_from_slice(&[2, 0, 0, 0, 0, ip.octets()[3]]);
            answer[36..40].copy_from_slice(&ip.octets());
            answer[52] = 255;
            answer[72..77].copy_from_slice(b"Cross");
            answer[104..108].copy_from_slice(b"Fake");
            answer[216..220].copy_from_slice(b"0001");
        }
        0x80 => {
            for i in (0..p.len()).step_by(4) {
                answer.extend(s.bytes(u32_at(p, i), 4));
            }
        }
        0x84 => {
            answer.extend(&p[..4]);
            answer.extend(s.bytes(u32_at(p, 0), usize::from(u16_at(p, 6))));
        }
        0x82 => {
            for i in (0..p.len()).step_by(8) {
                status = s.write(u32_at(p, i), u32_at(p, i + 4), from);
            }
            answer = vec![0, 0, 0, 1];
        }
        0x86 => {
            for i in (4..p.len()).step_by(4) {
                status = s.write(u32_at(p, 0) + i as u32 - 4, u32_at(p, i), from);
            }
            answer = vec![0, 0, 0, 4];
        }
        0x40 => {
            let to = SocketAddrV4::new(s.reg(0xd18).into(), s.reg(0xd00) as u16);
            for packet in u32_at(p, 4)..=u32_at(p, 8) {
                if let Some(d) = s.sent.get(&(u16_at(p, 2), packet)) {
                    let _ = images.send_to(d, to);
                }
            }
            return;
        }
        _ => status = 0x8001,
    }
    if status != 0 {
        answer.clear();
    }
    let mut ack = Vec::new();
    for v in [status, command + 1, answer.len() as u16, id] {
        ack.extend(v.to_be_bytes());
    }
    ack.extend(answer);
    let _ = control.send_to(&ack, from);
}

fn send(images: &UdpSocket, state: &Mutex<State>, mute: &AtomicBool, block: &mut u64) {
    let mut s = state.lock().unwrap();
    let (to, port) = (Ipv4Addr::from(s.reg(0xd18)), s.reg(0xd00) as u16);
    if s.reg(START) != 1 || port == 0 {
        *block = 0;
        drop(s);
        return std::thread::sleep(Duration::from_millis(5));
    }
    *block += 1;
    let (w, h, ticks) = (s.reg(WIDTH), s.reg(HEIGHT), s.ticks());
    let picture = (s.behaviour.picture)(
        ticks as f64 / s.behaviour.clock.ticks_hz as f64,
        w as usize,
        h as usize,
    );
    let head = |format: u8, packet: u32| {
        let mut d = vec![0, 0];
        d.extend((*block as u16).to_be_bytes());
        d.extend((u32::from(format) << 24 | packet).to_be_bytes());
        d
    };
    let mut packets = vec![head(1, 0)];
    packets[0].extend([0, 0, 0, 1]);
    packets[0].extend(ticks.to_be_bytes());
    for v in [s.reg(FORMAT), w, h, 0, 0, 0] {
        packets[0].extend(v.to_be_bytes());
    }
    for part in picture.chunks(s.reg(0xd04) as usize - 36) {
        let mut d = head(3, packets.len() as u32);
        d.extend(part);
        packets.push(d);
    }
    let mut d = head(2, packets.len() as u32);
    d.extend([0, 0, 0, 1]);
    d.extend(h.to_be_bytes());
    packets.push(d);
    let now = *block as u16;
    s.sent.retain(|(sent, _), _| now.wrapping_sub(*sent) < REMEMBERED);
    s.sent.extend(packets.iter().enumerate().map(|(i, d)| ((now, i as u32), d.clone())));
    let kept: Vec<_> = packets
        .into_iter()
        .enumerate()
        .filter(|(i, _)| !(s.behaviour.drops)(*block, *i as u32))
        .collect();
    let interval = Duration::from_secs_f64(1.0 / f64::from(f32::from_bits(s.reg(RATE))));
    drop(s);
    if !mute.load(SeqCst) {
        for (_, d) in kept {
            let _ = images.send_to(&d, (to, port));
        }
    }
    std::thread::sleep(interval);
}

fn xml() -> String {
    let reg = |name: &str, at: u32, len: u32, access: &str| {
        format!(
            "<IntReg Name=\"{name}\"><Address>{at:#x}</Address><Length>{len}</Length><AccessMode>{access}</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"
        )
    };
    let int = |name: &str, more: &str| {
        format!("<Integer Name=\"{name}\"><pValue>{name}Reg</pValue>{more}</Integer>")
    };
    let cmd = |name: &str, value: u32| {
        format!(
            "<Command Name=\"{name}\"><pValue>{name}Reg</pValue><CommandValue>{value}</CommandValue></Command>"
        )
    };
    let all = [
        reg("WidthReg", WIDTH, 4, "RW"), int("Width", "<Min>16</Min><Max>4096</Max><Inc>1</Inc>"), reg("HeightReg", HEIGHT, 4, "RW"), int("Height", "<Min>16</Min><Max>4096</Max><Inc>1</Inc>"),
        reg("PixelFormatReg", FORMAT, 4, "RW"), "<Enumeration Name=\"PixelFormat\"><EnumEntry Name=\"Mono8\"><Value>17301505</Value></EnumEntry><pValue>PixelFormatReg</pValue></Enumeration>".into(),
        "<IntSwissKnife Name=\"PayloadSize\"><pVariable Name=\"W\">WidthReg</pVariable><pVariable Name=\"H\">HeightReg</pVariable><Formula>W*H</Formula></IntSwissKnife>".into(),
        reg("PtpStatusReg", PTP, 4, "RO"),
        "<Enumeration Name=\"PtpStatus\"><EnumEntry Name=\"Disabled\"><Value>0</Value></EnumEntry><EnumEntry Name=\"Slave\"><Value>1</Value></EnumEntry><pValue>PtpStatusReg</pValue></Enumeration>".into(),
        reg("AcquisitionModeReg", MODE, 4, "RW"), "<Enumeration Name=\"AcquisitionMode\"><EnumEntry Name=\"Continuous\"><Value>0</Value></EnumEntry><pValue>AcquisitionModeReg</pValue></Enumeration>".into(),
        reg("AcquisitionStartReg", START, 4, "WO"), cmd("AcquisitionStart", 1), reg("AcquisitionStopReg", STOP, 4, "WO"), cmd("AcquisitionStop", 1),
        format!("<FloatReg Name=\"RateReg\"><Address>{RATE:#x}</Address><Length>4</Length><AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></FloatReg>"),
        "<Float Name=\"AcquisitionFrameRate\"><pValue>RateReg</pValue><Min>1</Min><Max>200</Max></Float>".into(),
        reg("GevTimestampControlLatchReg", 0x944, 4, "WO"), cmd("GevTimestampControlLatch", 2), reg("GevTimestampValueReg", 0x948, 8, "RO"), int("GevTimestampValue", ""), reg("GevTimestampTickFrequencyReg", 0x93c, 8, "RO"), int("GevTimestampTickFrequency", ""),
    ].concat();
    format!(
        "<?xml version=\"1.0\" encoding=\"utf-8\"?><RegisterDescription ModelName=\"Fake\" VendorName=\"Crossfix\" StandardNameSpace=\"GEV\" SchemaMajorVersion=\"1\" SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\" MajorVersion=\"1\" MinorVersion=\"0\" SubMinorVersion=\"0\" ProductGuid=\"a\" VersionGuid=\"b\" xmlns=\"http://www.genicam.org/GenApi/Version_1_1\"><Category Name=\"Root\"><pFeature>Width</pFeature></Category>{all}<Port Name=\"Device\"></Port></RegisterDescription>"
    )
}
