//! Every kind of source, whole and damaged.
#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::fs;
use std::path::Path;

use crossfix_video::{Frame, FrameClock, Pixels, Still, VideoError, decode_still, open};
use proptest::prelude::*;

fn png(
    width: u32,
    height: u32,
    color: png::ColorType,
    depth: png::BitDepth,
    samples: &[u8],
) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(samples).unwrap();
    bytes
}

fn gray(value: u8) -> Vec<u8> {
    png(4, 2, png::ColorType::Grayscale, png::BitDepth::Eight, &[value; 8])
}

/// All frames and all errors of a source.
fn read(path: &Path) -> (Vec<Frame>, Vec<VideoError>) {
    let mut source =
        open(path, FrameClock { fallback_rate_hz: 10.0, ..FrameClock::default() }).unwrap();
    let (mut frames, mut errors) = (Vec::new(), Vec::new());
    loop {
        match source.next_frame() {
            Ok(Some(frame)) => frames.push(frame),
            Ok(None) => return (frames, errors),
            Err(error) => {
                let goes_on = error.is_one_frame();
                errors.push(error);
                if !goes_on {
                    return (frames, errors);
                }
            }
        }
    }
}

#[test]
fn a_sequence_comes_in_the_order_of_its_numbers_with_times() {
    let folder = tempfile::tempdir().unwrap();
    for number in [10, 9, 8] {
        fs::write(folder.path().join(format!("f{number}.png")), gray(number)).unwrap();
    }
    let (frames, errors) = read(folder.path());
    assert!(errors.is_empty());
    let values: Vec<f32> = frames.iter().map(|frame| frame.brightness()[0]).collect();
    assert_eq!(values, [8.0, 9.0, 10.0]);
    assert_eq!(frames[2].capture.time.seconds(), 0.2);
}

#[test]
fn a_corrupt_png_costs_one_frame() {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("1.png"), gray(1)).unwrap();
    let whole = gray(2);
    fs::write(folder.path().join("2.png"), &whole[..whole.len() / 2]).unwrap();
    fs::write(folder.path().join("3.png"), gray(3)).unwrap();
    let (frames, errors) = read(folder.path());
    assert_eq!(frames.iter().map(|frame| frame.index).collect::<Vec<_>>(), [0, 2]);
    assert!(matches!(&errors[..], [VideoError::Frame { index: 1, .. }]), "{errors:?}");
}

#[test]
fn sixteen_bits_and_colour_are_kept() {
    let deep = png(1, 1, png::ColorType::Grayscale, png::BitDepth::Sixteen, &[0x12, 0x34]);
    let pixels = Pixels::Gray16(vec![0x1234]);
    assert_eq!(decode_still(&deep).unwrap(), Still { width: 1, height: 1, pixels });
    let colour = png(1, 1, png::ColorType::Rgba, png::BitDepth::Eight, &[1, 2, 3, 255]);
    let pixels = Pixels::Rgb8(vec![1, 2, 3]);
    assert_eq!(decode_still(&colour).unwrap(), Still { width: 1, height: 1, pixels });
}

#[test]
fn a_y4m_file_has_its_own_rate_and_may_be_torn() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.y4m");
    let mut bytes = b"YUV4MPEG2 W2 H2 F50:1 Cmono\n".to_vec();
    for value in [1_u8, 2, 3] {
        bytes.extend(b"FRAME\n");
        bytes.extend([value; 4]);
    }
    fs::write(&path, &bytes).unwrap();
    let (frames, _) = read(&path);
    assert_eq!(frames.len(), 3);
    assert_eq!(frames[2].capture.time.seconds(), 0.04);
    fs::write(&path, &bytes[..bytes.len() - 2]).unwrap();
    let (frames, errors) = read(&path);
    assert_eq!(frames.len(), 2);
    assert!(matches!(&errors[..], [VideoError::Frame { index: 2, .. }]), "{errors:?}");
}

#[test]
fn a_y4m_file_with_two_heights_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.y4m");
    // The library takes the second one, and multiplies beyond all numbers.
    fs::write(&path, "YUV4MPEG2 W4 H4 F30:1 W4 H4888888888888888888\nFRAME\n").unwrap();
    let error = open(&path, FrameClock::default()).err().unwrap();
    assert!(error.to_string().contains("a.y4m"), "{error}");
}

#[test]
fn a_y4m_file_of_sixteen_bits_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.y4m");
    let mut bytes = b"YUV4MPEG2 W1 H1 F25:1 Cmono16\nFRAME\n".to_vec();
    bytes.extend(0x1234_u16.to_le_bytes());
    fs::write(&path, &bytes).unwrap();
    assert_eq!(read(&path).0[0].pixels, Pixels::Gray16(vec![0x1234]));
}

#[test]
fn what_is_no_video_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let text = folder.path().join("notes.txt");
    fs::write(&text, "hello").unwrap();
    let kind = |path: &Path| open(path, FrameClock::default()).err().unwrap();
    assert!(matches!(kind(&text), VideoError::UnknownKind { .. }));
    assert!(matches!(kind(folder.path()), VideoError::Empty { .. }));
    assert!(matches!(kind(&folder.path().join("gone.mp4")), VideoError::Open { .. }));
    let mp4 = folder.path().join("a.mp4");
    fs::write(&mp4, [0_u8; 64]).unwrap();
    assert!(matches!(kind(&mp4), VideoError::Damaged { .. }));
}

/// Ten frames of 64x48 at 10 per second, H.264, whole and in fragments: see `data/README.md`.
const MP4: [&[u8]; 2] = [include_bytes!("data/whole.mp4"), include_bytes!("data/fragmented.mp4")];

#[test]
fn mp4_files_whole_and_in_fragments_have_all_their_frames() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    for bytes in MP4 {
        fs::write(&path, bytes).unwrap();
        let (frames, errors) = read(&path);
        assert!(errors.is_empty(), "{errors:?}");
        let times: Vec<f64> = frames.iter().map(|frame| frame.capture.time.seconds()).collect();
        let expected: Vec<f64> = (0..10).map(|k| f64::from(k) / 10.0).collect();
        assert_eq!(times, expected);
        assert_eq!((frames[9].width, frames[9].height), (64, 48));
    }
}

#[test]
fn an_mp4_file_that_is_cut_off_says_how_many_frames_are_missing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    // In fragments the index lies before its pictures.
    fs::write(&path, &MP4[1][..MP4[1].len() - 200]).unwrap();
    let (frames, errors) = read(&path);
    assert!((1..10).contains(&frames.len()), "{}", frames.len());
    assert_eq!(errors.len(), 1, "{errors:?}");
}

#[test]
fn a_fragment_that_claims_four_thousand_million_frames_is_read_in_time() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    let mut bytes = MP4[1].to_vec();
    let trun = bytes.windows(4).position(|word| word == b"trun").unwrap();
    // No fields of their own, so that twenty bytes claim them all.
    bytes[trun + 5..trun + 8].copy_from_slice(&[0, 0, 1]);
    bytes[trun + 8..trun + 12].copy_from_slice(&[0xff; 4]);
    fs::write(&path, &bytes).unwrap();
    if let Ok(mut source) = open(&path, FrameClock::default()) {
        let _ = source.next_frame();
    }
}

/// Whoever follows them one within the other runs out of stack.
#[test]
fn an_mp4_file_of_boxes_within_boxes_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    for kind in [b"moov", b"moof"] {
        let boxes = (1..=200_000_u32).rev();
        let bytes: Vec<u8> =
            boxes.flat_map(|rest| [&(8 * rest).to_be_bytes(), &kind[..]].concat()).collect();
        fs::write(&path, bytes).unwrap();
        assert!(open(&path, FrameClock::default()).is_err());
    }
}

#[test]
fn a_thousand_damaged_mp4_files_end_with_frames_or_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mp4");
    let mut random = 1_u64;
    let mut draw = |below: usize| {
        // Numbers from a page of Knuth's: the same on every machine.
        random =
            random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (random >> 33) as usize % below
    };
    let (mut good, mut bad) = (0, 0);
    for turn in 0..1000 {
        let mut bytes = MP4[turn % 2].to_vec();
        for _ in 0..1 + draw(4) {
            let at = draw(bytes.len() - 4);
            let word = [[0; 4], [0xff; 4], [0, 0, 0, 1], [0x7f, 0xff, 0xff, 0xff]][draw(4)];
            bytes[at..at + 4].copy_from_slice(&word);
        }
        fs::write(&path, &bytes).unwrap();
        // A damaged file that is read for ever, or that takes all memory, fails here.
        match open(&path, FrameClock::default()) {
            Ok(_) => {
                let (frames, errors) = read(&path);
                assert!(frames.len() + errors.len() <= 100, "turn {turn}");
                good += 1;
            }
            Err(_) => bad += 1,
        }
    }
    assert!(good > 100 && bad > 100, "{good} opened, {bad} refused");
}

#[test]
fn real_mp4_files_have_all_their_frames_and_survive_a_tear() {
    let Some(data) = std::env::var_os("CROSSFIX_DATA") else {
        eprintln!("SKIPPED: set CROSSFIX_DATA to the folder of real data");
        return;
    };
    let clip = Path::new(&data).join("svanstrom-drone-video/IR_DRONE_030.mp4");
    let (frames, errors) = read(&clip);
    assert!(errors.is_empty(), "{errors:?}");
    assert_eq!(frames.len(), 302);
    assert!(frames.is_sorted_by_key(|frame| frame.capture.time));
    assert_eq!((frames[0].width, frames[0].height), (320, 256));

    // The index first, the pictures after it: cut off in the middle of the pictures.
    let folder = tempfile::tempdir().unwrap();
    let torn = folder.path().join("torn.mp4");
    let bytes = fs::read(&clip).unwrap();
    fs::write(&torn, &bytes[..bytes.len() / 2]).unwrap();
    match open(&torn, FrameClock::default()) {
        Ok(_) => {
            let (frames, errors) = read(&torn);
            assert!(!frames.is_empty() && !errors.is_empty());
        }
        Err(error) => assert!(matches!(error, VideoError::Damaged { .. }), "{error}"),
    }
}

proptest! {
    #[test]
    fn any_damage_to_a_still_is_survived(at in any::<prop::sample::Index>(), value in any::<u8>()) {
        let mut bytes = gray(7);
        let index = at.index(bytes.len());
        bytes[index] ^= value;
        let _ = decode_still(&bytes);
    }
}

/// A file beside this test.
fn data(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

#[test]
fn an_avi_file_with_motion_jpeg_is_read_at_its_rate_past_its_sound() {
    let (frames, errors) = read(&data("motion.avi"));
    assert_eq!(frames.len(), 5, "{errors:?}");
    assert!(errors.iter().all(VideoError::is_one_frame), "{errors:?}");
    assert!(frames.iter().all(|frame| (frame.width, frame.height) == (64, 48)));
    for frame in &frames {
        assert!(
            (frame.capture.time.seconds() - frame.index as f64 / 25.0).abs() < 1e-6,
            "{:?}",
            frame.capture
        );
    }
    let brightness = frames[0].brightness();
    let (least, most) =
        brightness.iter().fold((255.0_f32, 0.0_f32), |(l, m), b| (l.min(*b), m.max(*b)));
    assert!(least < 40.0 && most > 200.0, "a test picture has dark and bright: {least} to {most}");
}

#[test]
fn what_an_avi_file_holds_that_is_not_read_is_named_with_what_converts_it() {
    let refused = |path: &Path| {
        let error = open(path, FrameClock::default()).err().unwrap();
        error.to_string()
    };
    let text = refused(&data("other.avi"));
    assert!(text.contains("FMP4") && text.contains("ffmpeg -i"), "{text}");
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in [
        ("film.mkv", b"\x1a\x45\xdf\xa3".as_slice()),
        ("empty.avi", b""),
        ("text.avi", b"RIFF, not"),
    ] {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        assert!(refused(&path).contains("ffmpeg -i"), "{name}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn an_avi_file_with_any_bytes_changed_ends(
        cut in 0_usize..20_000,
        changed in prop::collection::vec((0_usize..6000, any::<u8>()), 0..8),
    ) {
        let mut bytes = fs::read(data("motion.avi")).unwrap();
        for (at, byte) in changed {
            bytes[at] = byte;
        }
        bytes.truncate(cut.max(12));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.avi");
        fs::write(&path, bytes).unwrap();
        let Ok(mut source) = open(&path, FrameClock::default()) else { return Ok(()) };
        let mut calls = 0;
        while let Some(going_on) = match source.next_frame() {
            Ok(frame) => frame.map(|_| true),
            Err(error) => Some(error.is_one_frame()),
        } {
            calls += 1;
            prop_assert!(calls < 5000);
            if !going_on {
                break;
            }
        }
    }
}
