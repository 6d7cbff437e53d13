//! Pages of a PDF report, laid out by Typst.

use rayon::ThreadPoolBuilder;
use typst::diag::{FileError, FileResult, SourceDiagnostic};
use typst::foundations::{Bytes, Datetime, Smart};
use typst::layout::PagedDocument;
use typst::syntax::{FileId, Source, VirtualPath};
use typst::text::{Font, FontBook};
use typst::utils::LazyHash;
use typst::{Library, LibraryExt, World};
use typst_pdf::{PdfOptions, PdfStandard, PdfStandards, Timestamp};

use super::super::ReportError;
use super::super::report_content::Report;
use super::super::texts::ReportText as Text;
use super::fonts::Fonts;
use super::markup::{Markup, quoted};
use super::paper::Paper;

/// Stack of the thread that lays out a report. The SVG of a logo is drawn by recursion: a chain of 120 patterns needs more
/// than the usual 2 MB. The limits of [`ShopHeader`] for elements within each other and for references keep it within
/// this stack. The system gives only the part that is used.
///
/// [`ShopHeader`]: super::super::shop_header::ShopHeader
const STACK_BYTES: usize = 512 << 20;

/// Lays out the report `html` on pages, and returns them as PDF/A-2b. `report` is the content of the same report.
///
/// # Errors
/// Fails if no font on this computer has a character of the report.
pub(super) fn pdf(report: &Report, html: &str, paper: Paper) -> Result<Vec<u8>, ReportError> {
    let failed = |reason: String| ReportError::Pdf { run: report.run().to_owned(), reason };
    let markup = Markup::from_html(html, report.say(Text::AgainstLimit)).map_err(|error| failed(error.to_string()))?;
    let [left, right] = report.foot();
    let paper = match paper {
        Paper::A4 => "a4",
        Paper::Letter => "us-letter",
    };
    // A logo can have text too.
    let logos = markup.pictures.iter().filter_map(|(_, bytes)| std::str::from_utf8(bytes).ok());
    let fonts = Fonts::with_characters_of(&logos.fold(html.to_owned(), |all, svg| all + svg));
    let names: String = fonts.families().iter().map(|name| quoted(name) + ",").collect();
    let main = format!(
        "#import \"/report.typ\": *\n#show: report.with(title: {}, language: {}, paper: {}, fonts: ({names}), \
         foot: (left: {}, right: {}, page: {}, of: {}))\n{}",
        quoted(&report.title()),
        quoted(report.language.tag()),
        quoted(paper),
        quoted(&left),
        quoted(&right),
        quoted(report.say(Text::Page)),
        quoted(report.say(Text::CountOf)),
        markup.text
    );
    let desk = Desk::new(main, markup.pictures, fonts);
    let at = report.story.end.as_ref().map_or(&report.story.last, |end| &end.utc);
    let options = PdfOptions {
        ident: Smart::Custom(&report.verified.head),
        timestamp: datetime(at).map(Timestamp::new_utc),
        standards: PdfStandards::new(&[PdfStandard::A_2b]).map_err(|error| failed(error.to_string()))?,
        ..PdfOptions::default()
    };
    let told = |errors: &[SourceDiagnostic]| {
        errors.iter().map(|error| error.message.to_string()).collect::<Vec<_>>().join("; ")
    };
    let made = || {
        let document: PagedDocument = typst::compile(&desk).output.map_err(|errors| told(&errors))?;
        typst_pdf::pdf(&document, &options).map_err(|errors| told(&errors))
    };
    let thread = ThreadPoolBuilder::new().num_threads(1).stack_size(STACK_BYTES).build();
    thread.map_err(|error| failed(error.to_string()))?.install(made).map_err(failed)
}

/// Reads a time in UTC in the format RFC 3339, to the second.
fn datetime(utc: &str) -> Option<Datetime> {
    let number = |from: usize, to: usize| utc.get(from..to).and_then(|digits| digits.parse::<u16>().ok());
    let [month, day, hour, minute, second] = [(5, 7), (8, 10), (11, 13), (14, 16), (17, 19)]
        .map(|(from, to)| number(from, to).and_then(|value| u8::try_from(value).ok()));
    Datetime::from_ymd_hms(i32::from(number(0, 4)?), month?, day?, hour?, minute?, second?)
}

/// Everything that Typst can read: the report, its design, its pictures and the fonts. Nothing else is within reach, so a
/// report never depends on another file or on the present time.
struct Desk {
    library: LazyHash<Library>,
    book: LazyHash<FontBook>,
    fonts: Fonts,
    main: Source,
    design: Source,
    pictures: Vec<(FileId, Bytes)>,
}

impl Desk {
    fn new(main: String, pictures: Vec<(String, Vec<u8>)>, mut fonts: Fonts) -> Self {
        let id = |path: &str| FileId::new(None, VirtualPath::new(path));
        let book = std::mem::take(&mut fonts.book);
        Self {
            library: LazyHash::new(Library::default()),
            book: LazyHash::new(book),
            fonts,
            main: Source::new(id("/main.typ"), main),
            design: Source::new(id("/report.typ"), include_str!("report.typ").to_owned()),
            pictures: pictures.into_iter().map(|(path, bytes)| (id(&path), Bytes::new(bytes))).collect(),
        }
    }
}

impl World for Desk {
    fn library(&self) -> &LazyHash<Library> {
        &self.library
    }

    fn book(&self) -> &LazyHash<FontBook> {
        &self.book
    }

    fn main(&self) -> FileId {
        self.main.id()
    }

    fn source(&self, id: FileId) -> FileResult<Source> {
        let found = [&self.main, &self.design].into_iter().find(|source| source.id() == id);
        found.cloned().ok_or_else(|| FileError::NotFound(id.vpath().as_rootless_path().to_owned()))
    }

    fn file(&self, id: FileId) -> FileResult<Bytes> {
        let found = self.pictures.iter().find(|(path, _)| *path == id);
        found
            .map(|(_, bytes)| bytes.clone())
            .ok_or_else(|| FileError::NotFound(id.vpath().as_rootless_path().to_owned()))
    }

    fn font(&self, index: usize) -> Option<Font> {
        self.fonts.font(index)
    }

    fn today(&self, _: Option<i64>) -> Option<Datetime> {
        None
    }
}
