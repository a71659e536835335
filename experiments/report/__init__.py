"""Reports: one self-contained HTML file drawn from the records of a run. Nothing is computed here but layout.

page.py      sections, figures, tables, image galleries; the template
write.py     write_report(folder): from a run folder to its report.html
style.py     one colour and marker per method, numbers as text
plots.py     matplotlib figures as inline SVG that follows the reader's light or dark page
<name>.py    the section of experiment <name>
"""
