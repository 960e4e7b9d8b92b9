"""Talk to it: a page on which a sentence is typed and a robot does as told.

`session` is the conversation, without a web; `page` and `stage` show it to browsers,
`live` keeps both going, `film` keeps what was seen.
"""
